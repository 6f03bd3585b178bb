"""Pages in a real Chromium, without a window: no error, no request, no overflow of a narrow screen."""

import os
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

import diransac as dr
from diransac.report import write_report
from diransac.report.stores import write_fleet_report
from diransac.study import FleetRows, FleetStatus, summarise_fleet
from simulated import MACHINES, as_log, flight

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
IN_BROWSER = pytest.mark.skipif(CHROMIUM is None, reason="PAGES NOT LOOKED AT: there is no Chromium on this machine")
MACHINE = MACHINES["planar-rotorcraft"]
PROBE = """<!DOCTYPE html><body><iframe id="page" src="page.html" style="width:390px;height:3000px;border:0"></iframe>
<script>
const page = document.getElementById("page");
page.onload = () => {
  const inner = page.contentDocument, root = inner.documentElement;
  const box = inner.querySelector("input[data-shows]"), svg = inner.querySelector("svg.plot");
  const look = box ? box.dataset.shows : "", before = svg.getAttribute("viewBox");
  if (box) box.click();
  const hidden = look ? inner.querySelectorAll(`.off.${look}, .${look}.off`).length : 0;
  svg.dispatchEvent(new page.contentWindow.KeyboardEvent("keydown", { key: "+", bubbles: true }));
  const zoomed = svg.getAttribute("viewBox") !== before;
  const requests = page.contentWindow.performance.getEntriesByType("resource").length;
  const said = [root.scrollWidth, hidden, zoomed, requests, inner.querySelectorAll("svg").length];
  document.body.append(Object.assign(document.createElement("p"), { id: "found", textContent: said.join(" ") }));
};
</script></body>"""


def opened(page: Path) -> subprocess.CompletedProcess[str]:
    """What Chromium makes of a page: its elements on stdout, what it says on stderr."""
    words = ["--headless", "--no-sandbox", "--disable-gpu", "--allow-file-access-from-files", "--enable-logging=stderr"]
    return subprocess.run(
        [str(CHROMIUM), *words, "--v=0", "--virtual-time-budget=5000", "--dump-dom", page.as_uri()],
        capture_output=True,
        text=True,
        timeout=120,
        env={**os.environ, "HOME": str(page.parent)},
        check=False,
    )


def said_by(done: subprocess.CompletedProcess[str]) -> list[str]:
    """Messages of the page, such as what its content policy refuses."""
    return [line for line in done.stderr.splitlines() if "CONSOLE" in line]


@IN_BROWSER
def test_a_page_runs_in_a_browser_without_error_request_or_overflow(tmp_path: Path):
    logs = [as_log(MACHINE, *flight(MACHINE, 300, 0.01), 0.01)]
    result = dr.identify(dr.models.planar_rotorcraft(), logs[0], "ols")
    write_report(result, logs, tmp_path / "page.html")
    (tmp_path / "probe.html").write_text(PROBE)
    done = opened(tmp_path / "probe.html")
    found = re.search(r'<p id="found">([\d.]+) (\d+) (\w+) (\d+) (\d+)</p>', done.stdout)
    assert found, done.stderr[-2000:]
    width, hidden, zoomed, requests, n_plots = found.groups()
    assert float(width) <= 390
    assert int(hidden) > 0
    assert zoomed == "true"
    assert int(requests) == 0
    assert int(n_plots) > 5
    assert not said_by(done)
    assert not re.search(r"https?://", (tmp_path / "page.html").read_text())


@IN_BROWSER
def test_the_content_policy_of_the_page_of_a_fleet_lets_its_clouds_of_points_be_seen(tmp_path: Path):
    rng, n = np.random.default_rng(0), 12
    values, errors = {"mass": 1.0 + 0.01 * rng.standard_normal(n)}, {"mass": np.full(n, 0.01)}
    vehicles, names = np.repeat(["a", "b"], n // 2), tuple(f"{k}.csv" for k in range(n))
    status = FleetStatus(n, 0, 0, {})
    rows = FleetRows("sledge", {"mass": "kg"}, names, vehicles, values, errors, ("usable",) * n, status)
    write_fleet_report(summarise_fleet(rows), tmp_path / "fleet.html")
    done = opened(tmp_path / "fleet.html")
    assert done.stdout.count("data:image/png") == 2
    assert not said_by(done)
