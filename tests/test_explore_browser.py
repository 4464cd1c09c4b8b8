"""The page in a real browser: Debian's chromium, driven by selenium. Not part of ``make test``: see CONTRIBUTING.md."""

import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sb3_skillgraph import SkillGraphAgent
from sb3_skillgraph.envs import geometry_of
from sb3_skillgraph.explore.export import export
from sb3_skillgraph.explore.scene import Scene
from sb3_skillgraph.explore.session import Session, promised

webdriver = pytest.importorskip("selenium.webdriver")
pytest.importorskip("nicegui")
BY_TAG, BY_CSS = "tag name", "css selector"
CHROMIUM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
AGENTS = Path(__file__).parent.parent / "examples" / "agents"
#: For screenshots, which are there to be looked at.
SHOTS = Path("runs") / "screenshots"
pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None or DRIVER is None, reason="needs chromium and chromedriver"),
]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    options = webdriver.ChromeOptions()
    for argument in ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--window-size=1300,1000"):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"performance": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(executable_path=DRIVER))
    yield driver
    driver.quit()


@pytest.fixture
def page(request: pytest.FixtureRequest) -> Iterator[tuple[str, SkillGraphAgent, Any]]:
    """The address of a page that shows a trained agent, the agent, and its environment."""
    folder = AGENTS / request.param
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "sb3_skillgraph", "explore", str(folder), "--port", str(port), "--no-browser"]
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST")}  # NiceGUI minds
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
    assert server.stdout is not None
    assert f"http://127.0.0.1:{port}" in server.stdout.readline()
    env = gym.make({"point_medium": "SkillGraph/PointMazeMedium-v0", "ant_umaze": "SkillGraph/AntUMaze-v0"}[request.param])
    yield f"http://127.0.0.1:{port}", SkillGraphAgent.load(folder / "agent.zip", env=env), env
    server.terminate()
    server.wait(10)
    server.stdout.close()
    env.close()


def text_of(browser: Any) -> str:
    return str(browser.find_element(BY_TAG, "body").text)


def wait_for(browser: Any, text: str, seconds: float = 20.0) -> str:
    end = time.monotonic() + seconds
    while text not in text_of(browser):
        assert time.monotonic() < end, f"{text!r} is not in\n{text_of(browser)}"
        time.sleep(0.05)
    return text_of(browser)


def press(browser: Any, label: str) -> None:
    next(button for button in browser.find_elements(BY_TAG, "button") if button.text == label.upper()).click()


def click_at(browser: Any, scene: Scene, point: np.ndarray) -> None:
    """Click where a point is seen."""
    picture = browser.find_element(BY_CSS, ".q-page svg, svg[viewBox]")
    x, y = scene.frame.pixels(np.asarray(point)[None])[0]
    width, height = scene.frame.size
    actions = webdriver.ActionChains(browser)
    actions.move_to_element_with_offset(picture, int(x - width / 2), int(y - height / 2)).click().perform()


@pytest.mark.parametrize("page", ["point_medium", "ant_umaze"], indirect=True)
def test_a_click_gives_a_plan_and_go_goes_there(browser: Any, page: tuple[str, SkillGraphAgent, Any]) -> None:
    address, agent, env = page
    scene = Scene(agent, geometry_of(env))
    browser.get(address)
    wait_for(browser, "Promised")
    assert len(browser.find_elements(BY_CSS, "circle[id]")) == len(agent.events)
    away = np.linalg.norm(agent.graph.centers - agent.graph.centers[0], axis=1)
    goal = agent.graph.centers[int(away.argmax())]
    before = text_of(browser)
    click_at(browser, scene, goal)
    session = Session(agent, env)
    clicked = scene.frame.at(*np.round(scene.frame.pixels(goal[None])[0]))
    session.place("goal", (0, 1), clicked)
    assert promised(session.plan()) not in before
    wait_for(browser, promised(session.plan()))
    press(browser, "Go")
    text = wait_for(browser, "goal reached after", 120.0)
    n_steps = len(list(session.go()))
    assert f"goal reached after {n_steps} steps" in text
    SHOTS.mkdir(parents=True, exist_ok=True)
    browser.save_screenshot(str(SHOTS / f"{env.spec.id.rpartition('/')[2]}.png"))


@pytest.mark.parametrize("page", ["point_medium"], indirect=True)
def test_events_tell_what_is_known_of_them_and_walls_are_no_goals(
    browser: Any, page: tuple[str, SkillGraphAgent, Any]
) -> None:
    address, agent, env = page
    scene = Scene(agent, geometry_of(env))
    browser.get(address)
    wait_for(browser, "Promised")
    press(browser, "look at an event")
    click_at(browser, scene, agent.events[3].center)
    text = wait_for(browser, f"{agent.events[3].id}, a ")
    assert "lands in" in text
    press(browser, "goal")
    click_at(browser, scene, np.array([-3.5, -3.5]))
    wait_for(browser, "Not there")
    browser.save_screenshot(str(SHOTS / "event.png"))


@pytest.mark.parametrize("page", ["point_medium"], indirect=True)
def test_two_visitors_at_once_and_one_that_leaves(browser: Any, page: tuple[str, SkillGraphAgent, Any]) -> None:
    address, *_ = page
    browser.get(address)
    wait_for(browser, "Promised")
    press(browser, "Go")
    browser.switch_to.new_window("tab")
    browser.get(address)
    wait_for(browser, "Promised")
    assert "steps: " not in text_of(browser).partition("Happened")[2].partition("graph")[0]  # its own run has not begun
    press(browser, "Go")
    wait_for(browser, "goal reached after", 60.0)
    browser.close()  # and the first is still at it, or there
    browser.switch_to.window(browser.window_handles[0])
    wait_for(browser, "goal reached after", 60.0)


def test_the_exported_page_needs_no_network(browser: Any, tmp_path: Path) -> None:
    env = gym.make("SkillGraph/PointMazeMedium-v0")
    agent = SkillGraphAgent.load(AGENTS / "point_medium" / "agent.zip", env=env)
    export(agent, tmp_path / "graph.html", geometry_of(env))
    browser.get("about:blank")  # so that no other page asks for anything any more
    time.sleep(1.0)
    browser.get_log("performance")
    browser.get((tmp_path / "graph.html").as_uri())
    browser.find_element(BY_CSS, f"circle[id='{agent.events[3].id}']").click()
    assert "Options that begin here" in text_of(browser)
    requests = [
        entry["message"] for entry in browser.get_log("performance") if 'Network.requestWillBeSent"' in entry["message"]
    ]
    assert all("graph.html" in request for request in requests), requests
    browser.save_screenshot(str(SHOTS / "export.png"))
