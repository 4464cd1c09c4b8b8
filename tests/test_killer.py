"""Some of the moments at which a run can be broken off; ``python -m tests.killer`` tries all of them."""

from pathlib import Path

from killer import Campaign


def test_whatever_happens_to_a_run_the_same_command_comes_to_the_same(tmp_path: Path) -> None:
    campaign = Campaign(tmp_path)
    assert campaign.n_operations > 100
    campaign.at_operations(every=17)
    campaign.at_random(4, seed=1)
    campaign.out_of_disk(3)
    assert not campaign.failures, "\n".join(campaign.failures)
    assert campaign.endings[-9] >= campaign.n_operations // 17
