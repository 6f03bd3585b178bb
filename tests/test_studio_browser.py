"""The studio in a real Chromium, without a window: from a log to an exported model, narrow, wide, light and dark."""

import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

import diransac as dr
from studio_client import write_spring, write_swim

exceptions = pytest.importorskip("selenium.common.exceptions", reason="STUDIO NOT LOOKED AT: selenium is missing")
StaleElementReferenceException = exceptions.StaleElementReferenceException
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
DRIVER = shutil.which("chromedriver")
pytest.importorskip("starlette", reason="STUDIO NOT LOOKED AT: pip install 'diransac[studio]'")
webdriver = pytest.importorskip("selenium.webdriver", reason="STUDIO NOT LOOKED AT: selenium is missing")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not (CHROMIUM and DRIVER), reason="STUDIO NOT LOOKED AT: no Chromium with chromedriver here"),
]
STAGES = ("data", "model", "check", "solve", "results", "use")
HOSTILE = '<img src=x onerror="document.title=1">'


class Server:
    """A studio in a process of its own."""

    def __init__(self, *given):
        words = [sys.executable, "-m", "diransac", "studio", *map(str, given), "--port", "0", "--no-browser"]
        self.process = subprocess.Popen(words, stderr=subprocess.PIPE, text=True)
        self.address = self.process.stderr.readline().split()[0]

    def end(self):
        """End it as Ctrl-C does."""
        self.process.send_signal(signal.SIGINT)
        self.process.wait(10)
        self.process.stderr.close()


class Page:
    """A tab, with what a person does in it."""

    def __init__(self, driver):
        self.driver = driver

    def open(self, address, stage="data", width=1400, dark=False):
        """Show a stage."""
        size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
        self.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        look = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
        self.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": look})
        self.driver.get("about:blank")
        self.driver.get(f"{address}#{stage}")
        self.wait("#connection:not(.lost)", "connected")

    def wait(self, selector, text="", seconds=20.0):
        """The first element with a text."""
        script = "return [...document.querySelectorAll(arguments[0])].find((x) => x.textContent.includes(arguments[1]))"
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if found := self.driver.execute_script(script, selector, text):
                return found
            time.sleep(0.02)
        raise AssertionError(f"{selector} {text!r}: not in {self.text()}")

    def click(self, selector, text=""):
        """Click on the first element with a text."""
        for _ in range(20):
            found = self.wait(selector, text)
            try:
                self.driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", found)
                found.click()
            except StaleElementReferenceException:  # it has just been drawn again
                continue
            return

    def choose(self, label, value):
        """Choose an entry of a menu."""
        self.wait(f"select[aria-label='{label}']")
        script = (
            "const x = document.querySelector(arguments[0]);"
            "x.value = arguments[1]; x.dispatchEvent(new Event('change'))"
        )
        self.driver.execute_script(script, f"select[aria-label='{label}']", value)

    def go(self, stage):
        """Go to a stage by its link."""
        self.click(f"nav a[href='#{stage}']")

    def text(self):
        """The text of the page."""
        return self.driver.execute_script("return document.body.innerText")

    def complaints(self):
        """What the browser reports as wrong."""
        return [x["message"] for x in self.driver.get_log("browser") if x["level"] == "SEVERE"]


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for word in ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--enable-unsafe-swiftshader"):
        options.add_argument(word)
    options.add_argument(f"--user-data-dir={tmp_path_factory.mktemp('profile')}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(DRIVER))
    yield Page(driver)
    driver.quit()


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    folder = tmp_path_factory.mktemp("studio")
    write_swim(folder / "swim.csv", 400)
    write_swim(folder / "other.csv", 300, 7.0)
    log = dr.read_log(folder / "swim.csv")
    columns = {HOSTILE if name == "thrust" else name: log[name] for name in log.names}
    dr.Log.from_arrays(log.time, columns).write(folder / "odd.csv")
    (folder / "wrong.csv").write_text("t,x\n0,1\n0,2\nx\n")
    found = Server(folder)
    found.folder = folder
    yield found
    found.end()


def test_a_new_user_comes_from_a_log_to_an_exported_model_without_the_keyboard(page, server):
    page.open(server.address)
    page.choose("role of swim.csv", "logs")
    page.choose("role of other.csv", "held-out")
    page.wait(".plot h4", "x_dot")
    page.go("model")
    page.click(".list button", "underwater-vehicle")
    page.wait("pre", "quadratic_drag")
    page.wait("canvas[aria-label^='The machine']")
    page.go("check")
    page.wait(".is-good", "well determined")
    page.go("solve")
    page.click("main button", "Solve")
    page.driver.refresh()  # a solve survives a reload
    page.click("main a", "See the results")
    page.wait(".card h3", "usable")
    page.click("main button", "Predict other.csv")
    page.wait(".card h3", "Held out")
    frame = page.wait("iframe")
    page.driver.switch_to.frame(frame)
    page.wait("h2", "Parameters")
    page.driver.switch_to.default_content()
    page.go("use")
    page.click("main tr:first-child button", "Write")
    page.wait("main a", "Download dynamics.c")
    assert "linear_drag" in (server.folder / "diransac-results/dynamics.c").read_text()
    assert 'model = "underwater-vehicle"' in (server.folder / "project.diransac.toml").read_text()
    page.click("footer button", "Python")
    page.wait("footer code", "result.export")
    assert not page.complaints()


@pytest.mark.parametrize(("width", "dark"), [(1400, False), (800, True)])
def test_every_stage_fits_its_window_light_and_dark(page, server, width, dark):
    page.open(server.address, "data", width, dark)
    for stage in STAGES:
        page.go(stage)
        page.wait("h2", stage.capitalize())
        over = "return document.documentElement.scrollWidth - innerWidth"
        assert page.driver.execute_script(over) <= 0, stage
        paper, ink = page.driver.execute_script(
            "const x = getComputedStyle(document.body);"
            "return [x.backgroundColor, x.color].map((y) => y.match(/\\d+/g)[0])"
        )
        assert (int(paper) < int(ink)) == dark
    assert not page.complaints()


def test_plots_zoom_by_keyboard_and_a_drag_leaves_a_stretch_out(page, server):
    page.open(server.address)
    page.click(".list button", "swim.csv")
    painted = "return document.querySelector('[data-painted]').dataset.painted.split(' ').map(Number)"
    page.wait("[data-painted]")
    before = page.driver.execute_script(painted)
    frame = page.wait(".plot")
    page.driver.execute_script("arguments[0].focus()", frame)
    frame.send_keys("+")
    time.sleep(0.4)
    after = page.driver.execute_script(painted)
    assert np.ptp(after) == pytest.approx(np.ptp(before) / 2, rel=1e-6)
    frame.send_keys("0")
    page.click("main button", "Drag to leave out")
    plot = page.wait(".plot .u-over")
    moves = webdriver.ActionChains(page.driver).move_to_element(plot).click_and_hold()
    moves.move_by_offset(80, 0).release().perform()
    page.wait(".chip", "✕")
    assert "leave-out = [[" in (server.folder / "project.diransac.toml").read_text()
    page.click(".chip", "✕")
    page.wait("footer code", "inspect")
    assert not page.complaints()


def test_text_of_files_stays_text_and_is_mapped_by_a_drop(page, server):
    page.open(server.address)
    page.choose("role of swim.csv", "")
    page.choose("role of odd.csv", "logs")
    page.wait(".chip", HOSTILE)
    drop = """
    const data = new DataTransfer();
    const of = (x) => new DragEvent(x, {dataTransfer: data, bubbles: true, cancelable: true});
    const find = (place, text) => [...document.querySelectorAll(place)].find((x) => x.textContent.includes(text));
    find(".chip", arguments[0]).dispatchEvent(of("dragstart"));
    const row = find("main tr", "thrust");
    row.dispatchEvent(of("dragover"));
    row.dispatchEvent(of("drop"));
    """
    page.wait("main tr", "thrust")
    page.driver.execute_script(drop, HOSTILE)
    page.wait("footer code", "--map")
    assert page.driver.execute_script("return document.querySelectorAll('img').length") == 0
    assert page.driver.title != "1"
    page.go("check")
    page.wait(".is-good", "well determined")
    assert not page.complaints()
    page.go("data")
    page.click("main button", "Clear")


def test_a_suggested_term_is_added_by_a_click_and_taken_back_by_another(page, server):
    write_spring(server.folder / "spring.csv")
    page.open(server.address)
    page.choose("role of spring.csv", "logs")
    for name in ("swim.csv", "odd.csv"):
        page.choose(f"role of {name}", "")
    page.go("model")
    page.click(".list button", "underwater-vehicle")
    page.wait("input[aria-label*='bias']").send_keys("2", webdriver.Keys.TAB)
    page.wait("footer code", "underwater")
    page.go("solve")
    page.click("main button", "Solve")
    page.click("main a", "See the results")
    page.click("main tr button", "Add and solve again")
    page.wait("h2", "Solve")
    chip = page.wait(".chip", "✕")
    term = chip.text.split()[0]
    page.click("main a", "See the results")
    page.wait("main th", term)
    page.go("solve")
    page.click(".chip", "✕")
    page.wait("footer code", "identify")
    assert "add-terms" not in (server.folder / "project.diransac.toml").read_text()
    assert not page.complaints()


def test_a_bad_file_is_said_in_a_sentence(page, server):
    page.open(server.address)
    page.click(".list button", "wrong.csv")
    page.wait(".error", "wrong.csv")


def test_own_code_is_shown_and_named_before_it_runs(page, server):
    code = "import diransac as dr\nmodel = dr.models.servo_axis()\nopen('ran', 'w')\n"
    (server.folder / "own.py").write_text(code)
    page.open(server.address, "model")
    page.click(".list button", "own.py")
    page.wait("pre", "servo_axis")
    assert not (server.folder / "ran").exists()
    page.click("main button", "Run own.py")
    page.wait("th", "dry_friction")
    assert (server.folder / "ran").exists()


def test_stages_are_reached_by_the_keyboard(page, server):
    page.open(server.address)
    keys = webdriver.Keys
    for _ in range(12):
        page.driver.switch_to.active_element.send_keys(keys.TAB)
        if page.driver.switch_to.active_element.text == "Solve":
            break
    page.driver.switch_to.active_element.send_keys(keys.ENTER)
    page.wait("h2", "Solve")
    assert page.driver.execute_script("return document.activeElement.id") == "stage"


def test_a_lost_connection_is_said(page, tmp_path):
    other = Server(tmp_path)
    page.open(other.address)
    other.end()
    page.wait("#connection.lost", "connection lost")
