"""What may stand in a file: small checks that are put together into schemas; each names the place that is wrong."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th

#: Takes a value and the place where it stands; raises a ValueError that names the place.
Check = Callable[[Any, str], None]
#: Whole numbers beyond which nothing is counted.
MOST = 2**53
#: Numbers beyond which nobody measures: their squares must fit a float32.
HUGE = 1e15
#: Numbers of a network beyond which its first products are infinite, and moments of their gradients.
LARGEST_WEIGHT, LARGEST_GRADIENT = 1e5, 1e12
#: What Adam keeps of every parameter.
ADAM_STATE = {"step", "exp_avg", "exp_avg_sq"}
#: Settings of an optimiser that files of an older torch may lack: torch fills them in.
TORCH_FILLS = {"amsgrad", "maximize", "foreach", "capturable", "differentiable", "fused", "decoupled_weight_decay", "nesterov"}


def refuse(where: str, wanted: str, value: Any) -> None:
    """Refuse a value.

    :raises ValueError: always
    """
    text = f"an array of {value.dtype} of shape {value.shape}" if isinstance(value, np.ndarray) else repr(value)[:60]
    raise ValueError(f"{where} must be {wanted}, not {text}.")


def number(low: float = -np.inf, high: float = np.inf, kinds: Any = int | float, what: str = "a number") -> Check:
    """Check a finite number in a range."""
    upper = " on" if high >= MOST else f" to {high:g}"
    wanted = what if low <= -MOST and high >= MOST else f"{what} from {low:g}{upper}"

    def check(value: Any, where: str) -> None:
        if not isinstance(value, kinds) or isinstance(value, bool) or not low <= value <= high or abs(value) == np.inf:
            refuse(where, wanted, value)

    return check


def whole(low: int = 0, high: int = MOST) -> Check:
    """Check a whole number in a range."""
    return number(low, high, int, "a whole number")


def flag(value: Any, where: str) -> None:
    """Check a bool."""
    if not isinstance(value, bool):
        refuse(where, "true or false", value)


def text(value: Any, where: str) -> None:
    """Check a string."""
    if not isinstance(value, str):
        refuse(where, "a text", value)


def one_of(*values: Any) -> Check:
    """Check one of some values."""

    def check(value: Any, where: str) -> None:
        if not any(type(value) is type(known) and value == known for known in values):
            refuse(where, f"one of {values}", value)

    return check


def optional(check: Check) -> Check:
    """Check a value that may be None."""
    return lambda value, where: None if value is None else check(value, where)


def array(shape: tuple[int | None, ...], kinds: str = "f", low: float = -HUGE, high: float = HUGE) -> Check:
    """Check an array of finite numbers.

    :param shape: its shape, None where any length will do
    :param kinds: of its dtype, as NumPy names them
    :param low: least value
    :param high: greatest value
    """

    def check(value: Any, where: str) -> None:
        fits = isinstance(value, np.ndarray) and value.dtype.kind in kinds and len(value.shape) == len(shape)
        if not fits or any(wanted not in (None, own) for wanted, own in zip(shape, value.shape, strict=True)):
            refuse(where, f"an array of shape {shape} and a dtype of kind {kinds!r}", value)
        if value.dtype.kind in "fi" and value.size and not (np.isfinite(value) & (low <= value) & (value <= high)).all():
            refuse(where, f"an array of numbers from {low:g} to {high:g}", value)

    return check


def list_of(check: Check, length: int | None = None, kind: type[list[Any] | tuple[Any, ...]] = list) -> Check:
    """Check a list, or a tuple, item by item."""

    def check_all(value: Any, where: str) -> None:
        if not isinstance(value, kind) or length not in (None, len(value)):
            refuse(where, f"a {kind.__name__}" + ("" if length is None else f" of {length}"), value)
        for i, item in enumerate(value):
            check(item, f"{where}/{i}")

    return check_all


def sized(check: Check, least: int, most: int = MOST) -> Check:
    """Check what may have from so many rows to so many."""

    def check_length(value: Any, where: str) -> None:
        check(value, where)
        if not least <= len(value) <= most:
            refuse(where, f"of {least} rows at least" if len(value) < least else f"of {most} rows at most", value)

    return check_length


def each(*checks: Check, kind: type[list[Any] | tuple[Any, ...]] = list) -> Check:
    """Check a list, or a tuple, whose items are of different kinds."""

    def check(value: Any, where: str) -> None:
        list_of(lambda *_: None, len(checks), kind)(value, where)
        for i, (item, check_item) in enumerate(zip(value, checks, strict=True)):
            check_item(item, f"{where}/{i}")

    return check


def dict_of(check: Check) -> Check:
    """Check a dictionary with any texts as keys."""

    def check_all(value: Any, where: str) -> None:
        if not isinstance(value, dict):
            refuse(where, "a dictionary", value)
        for name, item in value.items():
            text(name, f"{where}, a key")
            check(item, f"{where}/{name}")

    return check_all


def entries(more: bool = False, /, **checks: Check) -> Check:
    """Check a dictionary with these keys.

    :param more: whether it may have others
    """

    def check(value: Any, where: str) -> None:
        if not isinstance(value, dict) or not set(checks) <= set(value) or (not more and set(checks) != set(value)):
            refuse(where, f"a dictionary with {', '.join(checks)}", list(value) if isinstance(value, dict) else value)
        for name, check_entry in checks.items():
            check_entry(value[name], f"{where}/{name}")

    return check


def anything(value: Any, where: str) -> None:
    """Leave the check to whoever reads the value."""


# -- networks ---------------------------------------------------------------------------------------------------------


def tensor(shape: tuple[int, ...], low: float, high: float) -> Check:
    """Check a tensor, or an array, of finite numbers."""

    def check(value: Any, where: str) -> None:
        held = value.detach().cpu().numpy() if isinstance(value, th.Tensor) else value
        array(shape, "fiu", low, high)(held, where)

    return check


def state_dict(like: dict[str, Any], limit: float = LARGEST_WEIGHT) -> Check:
    """Check a network's tensors.

    :param like: those of a network of the same kind
    :param limit: how large their numbers may be
    """
    return entries(**{name: tensor(tuple(own.shape), -limit, limit) for name, own in like.items()})


def optimizer_state(optimizer: th.optim.Optimizer) -> Check:
    """Check what an optimiser knows: for each parameter tensors of its shape, or numbers; squares are not negative.

    :param optimizer: of a network of the same kind
    """
    shapes = [tuple(parameter.shape) for group in optimizer.param_groups for parameter in group["params"]]
    groups = optimizer.state_dict()["param_groups"]
    limit = LARGEST_GRADIENT

    def check_moment(name: str, shape: tuple[int, ...]) -> Check:
        low, high = (0.0, limit**2) if name in ("exp_avg_sq", "max_exp_avg_sq", "square_avg", "step") else (-limit, limit)
        moment = tensor(() if name == "step" else shape, low, high)
        return moment if name in ADAM_STATE else optional(moment)

    def check_one(value: Any, where: str, shape: tuple[int, ...]) -> None:
        dict_of(anything)(value, where)
        for name, moment in value.items():
            check_moment(name, shape)(moment, f"{where}/{name}")

    def check(value: Any, where: str) -> None:
        entries(state=anything, param_groups=list_of(anything, len(groups)))(value, where)
        state = value["state"]
        if not isinstance(state, dict) or (state and set(state) != set(range(len(shapes)))):
            refuse(f"{where}/state", f"a dictionary of {len(shapes)} parameters, or empty", state)
        names = [set(moments) if isinstance(moments, dict) else set() for moments in state.values()]
        if any(own != names[0] for own in names):
            refuse(f"{where}/state", "the same for all parameters", names)
        for i, moments in state.items():
            check_one(moments, f"{where}/state/{i}", shapes[i])
        if type(optimizer) in (th.optim.Adam, th.optim.AdamW) and state and not names[0] >= ADAM_STATE:
            refuse(f"{where}/state", "Adam's: step, exp_avg and exp_avg_sq", names[0])
        for i, (own, given) in enumerate(zip(groups, value["param_groups"], strict=True)):
            entries(True, lr=number(0.0, 1e3), params=one_of(own["params"]))(given, f"{where}/param_groups/{i}")
            for name in set(own) - {"lr", "initial_lr"} - (TORCH_FILLS - set(given)):
                one_of(own[name])(given.get(name), f"{where}/param_groups/{i}/{name}")

    return check
