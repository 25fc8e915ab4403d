"""The page in a real browser: what it shows, and that it goes on when robots and the service come and go."""

import threading
import time
from contextlib import contextmanager
from pathlib import Path

import pytest

from pipelines.serve.client import TerrainClient

from .strangers import CHANNELS, running

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")

MOTORS = [f"motor_{i}_radps" for i in (1, 2, 3)] + [f"current_{i}_a" for i in (1, 2, 3)]
SENT = {**CHANNELS, "wheels": [*CHANNELS["wheels"], *MOTORS]}
TOKEN = "a token of the page's test"
MARKUP = "<img src=x onerror=document.title='run'>"

CHECKS = Path(__file__).with_name("page_checks.js")
INK = "(canvas) => inkOf(canvas)"  #: Number of colours of a canvas


@pytest.fixture
def opened(browser):
    """Opens pages; afterwards none of them has complained or asked another host."""
    contexts, faults = [], []

    def of(service, complaints=True, **options):
        context = browser.new_context(**options)
        contexts.append(context)
        context.add_init_script(path=CHECKS)
        page = context.new_page()
        page.set_default_timeout(10_000)
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.on("request", lambda one: one.url.startswith(service.http) or faults.append(one.url))
        if complaints:
            page.on("console", lambda one: faults.append(one.text) if one.type == "error" else None)
        page.goto(service.http)
        return page

    yield of
    for context in contexts:
        context.close()
    assert faults == []


@contextmanager
def robot(service, session="mower-1", **options):
    """A robot that drives until the block ends."""
    ended = threading.Event()

    def drive():
        name = "agrimaro" if options.get("control") else "mower"
        with TerrainClient(service.ws, session, name, SENT, rate_hz=20.0, **options) as client:
            begun_s, k = time.monotonic(), 0
            while not ended.wait(max(begun_s + 0.02 * k - time.monotonic(), 0.0)):
                now_s, k = begun_s + 0.02 * k, k + 1  # of a sensor: even, however late they are sent
                rows = {"imu": [2.0 if k % 2 else -2.0], "wheels": [0.5, 20.0, 21.0, 19.0, 1.0, 1.5, 2.0]}
                client.send({stream: ([now_s], [row]) for stream, row in rows.items()}, (0.5, 0.0, 0.0))

    thread = threading.Thread(target=drive)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join(20)


def shows(page, place, text, timeout_s=8.0):
    """Wait until an element holds a text."""
    playwright.expect(page.locator(place)).to_contain_text(text, timeout=timeout_s * 1000)


def assert_readable(page):
    found = page.evaluate("lowestContrast()")
    assert found[0] >= 4.5, found


def test_a_robot_is_shown_with_terrain_target_and_model_and_markup_is_text(service, opened):
    service.hub.trouble["<b>"] = MARKUP
    with robot(service):
        page = opened(service, viewport={"width": 1280, "height": 900})
        shows(page, "#connection", "live")
        shows(page, "#probability", "%")
        assert page.inner_text("#terrain") in ("a", "b")
        shown = {"window": "last window", "target": "traction", "sensors": "fresh", "model": "(number 1)"}
        for place, text in (shown | {"trouble": MARKUP, "answer": MARKUP}).items():
            shows(page, f"#{place}", text)
        assert page.query_selector("main img") is None
        assert page.title() == "Terrain, live"
        page.wait_for_timeout(300)
        assert page.eval_on_selector("#band", INK) > 3
        assert_readable(page)
        page.reload()
        shows(page, "#probability", "%")
    del service.hub.trouble["<b>"]


@pytest.mark.slow
def test_a_driven_robot_is_shown_with_command_and_plots_in_light_and_dark_and_on_a_phone(driving, opened):
    with robot(driving, "R" * 64, control=True):
        page = opened(driving, color_scheme="dark", viewport={"width": 1280, "height": 900})
        shows(page, "#command-status", "ok")
        shows(page, "#twist", "driven: 0.50")
        page.click("#more summary")
        playwright.expect(page.locator("#current canvas")).to_have_count(1)
        page.wait_for_timeout(1000)
        for canvas in page.query_selector_all("#slip canvas, #current canvas"):
            assert canvas.evaluate(INK) > 3 or not canvas.is_visible()
        dark = page.eval_on_selector("body", "(body) => getComputedStyle(body).backgroundColor")
        assert_readable(page)
        page.click("#theme")
        assert page.eval_on_selector("body", "(body) => getComputedStyle(body).backgroundColor") != dark
        assert page.get_attribute("#theme", "aria-pressed") == "false"
        assert_readable(page)
        page.reload()
        assert page.get_attribute("html", "data-theme") == "light"
        phone = opened(driving, viewport={"width": 390, "height": 844}, is_mobile=True, device_scale_factor=2)
        shows(phone, "#command-status", "ok")
        phone.wait_for_timeout(500)
        assert phone.locator("#slip-heading").bounding_box()["y"] > 780, "one message on the first screen"
        phone.click("#more summary")
        assert phone.evaluate("document.documentElement.scrollWidth") <= 390


def test_robots_come_and_go_and_are_chosen_by_the_keyboard(driving, opened):
    page = opened(driving)
    shows(page, "#connection", "no robot yet")
    with robot(driving, "first", control=True):
        shows(page, "#connection", "live")
        with robot(driving, "second", control=True):
            playwright.expect(page.locator("#session option")).to_have_count(2)
            while page.evaluate("document.activeElement.id") != "session":
                page.keyboard.press("Tab")
            assert page.evaluate("getComputedStyle(document.activeElement).outlineStyle") == "solid"
            page.keyboard.press("ArrowDown")
            playwright.expect(page.locator("#session")).to_have_value("second")
        shows(page, "#session", "first")
        shows(page, "#connection", "live")
    shows(page, "#connection", "no robot any more")
    assert page.evaluate("document.body.classList.contains('stale')")


@pytest.mark.slow
def test_the_page_asks_for_a_token_says_that_the_service_has_gone_and_goes_on_when_it_is_back(
    model_folder, opened, monkeypatch
):
    monkeypatch.setenv("TERRAIN_TOKEN", TOKEN)
    with running(model=str(model_folder)) as service, robot(service, token=TOKEN):
        page = opened(
            service, complaints=False, color_scheme="dark"
        )  # Chromium's own, of what it could not get
        shows(page, "#connection", "a token is required")
        assert page.evaluate("document.activeElement.id") == "token"
        page.keyboard.type("x" * 20)
        page.keyboard.press("Enter")
        shows(page, "#token-error", "That is not the token.")
        assert_readable(page)
        page.fill("#token", TOKEN)
        page.keyboard.press("Enter")
        shows(page, "#connection", "live")
        playwright.expect(page.locator("#token-form")).to_be_hidden()
        page.reload()
        shows(page, "#connection", "live")
        port = int(service.http.rpartition(":")[2])
    playwright.expect(page.locator("#connection")).to_have_attribute("data-state", "lost", timeout=3000)
    assert page.evaluate("document.body.classList.contains('stale')")
    page.wait_for_timeout(600)
    assert_readable(page)
    with running(port=port, model=str(model_folder)) as service, robot(service, token=TOKEN):
        shows(page, "#connection", "live")
        assert not page.evaluate("document.body.classList.contains('stale')")
