"""The studio without a browser: its project file, commands, logs, views and jobs."""

import json
import os
import shlex
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import numpy as np
import pytest

import diransac as dr
from command_line import run, working_folder
from diransac import time_limit
from diransac.data import preprocessing
from diransac.identification.assessment.inspection import inspect
from diransac.studio.project import Project

pytest.importorskip("starlette", reason="STUDIO NOT CHECKED: pip install 'diransac[studio]'")
from diransac.studio import hosts_of
from diransac.studio.folders import Folders
from diransac.studio.scene import _content
from diransac.studio.series import Logs
from diransac.studio.stages import lines
from lerobot_datasets import write_dataset
from recordings import write_mcap
from robots import urdf
from studio_client import Client, write_spring, write_swim

FULL = {
    "model": "arm.urdf",
    "logs": ["a.csv", "-b.csv"],
    "held-out": ["c.csv"],
    "map": {"x": 'a "quoted" \\ name', "t": "stamp\u202e"},
    "scale": {"x": -0.5},
    "leave-out": [[1.0, 2.5], [3.0, 4.0]],
    "from": 0.5,
    "while": ["airborne"],
    "unknown": ["armature", "damping"],
    "control": {"kp": 20.0, "target": "des_{}"},
    "fix": {"mass": 0.9, "g": "nominal"},
    "prior": {"drag": [1.0, 0.1]},
    "settings": {"sample_size": 50, "outliers": False},
    "with-suggestions": True,
    "time-limit": 30.0,
}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    return working_folder(tmp_path, monkeypatch)


# ---------------------------------------------------------------------- project


def test_a_project_file_reads_back_whatever_its_texts(tmp_path):
    project = Project.of(FULL, "test")
    project.save(tmp_path / "p.toml")
    assert Project.load(tmp_path / "p.toml") == project
    assert "\u202e" not in (tmp_path / "p.toml").read_text()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("model = 3", "model"),
        ("[out]\nx = 1", "out"),
        ("seed = 0.5", "seed"),
        ("fix = {a = 'b'}", "fix"),
        ("=", "TOML"),
    ],
)
def test_a_project_file_with_something_else_is_refused(folder, text, said):
    Path("p.toml").write_text(text)
    done = run("identify", "--config", "p.toml")
    assert done.exit_code == 1
    assert said in done.stderr


def test_words_of_a_project_are_options_of_identify():
    words = Project.of(FULL, "test").words(Path("there"))
    assert words[:4] == ["there/a.csv", "there/-b.csv", "--model", "there/arm.urdf"]
    assert Project.of(FULL, "test").words()[1] == "./-b.csv"
    for pair in (
        ["--leave-out", "1:2.5,3:4"],
        ["--fix", "g"],
        ["--prior", "drag=1.0,0.1"],
        ["--set", "outliers=false"],
    ):
        assert any(words[k : k + 2] == pair for k in range(len(words))), pair
    assert words.count("--with-suggestions") == 1


def test_identify_takes_a_project_and_options_besides_win(folder):
    options = {
        "model": "underwater-vehicle",
        "logs": ["swim.csv"],
        "method": "ols",
        "leave-out": [[1.0, 2.0]],
        "seed": 3,
    }
    Project.of(options, "test").save(folder / "sub.toml")
    os.chdir("/")
    found = json.loads(run("identify", "--config", folder / "sub.toml", "--json").stdout)
    other = json.loads(run("identify", f"--config={folder / 'sub.toml'}", "--seed", "5", "--json").stdout)
    assert (found["method"], found["seed"], other["seed"]) == ("ols", 3, 5)
    assert found["parameters"]["mass"] == pytest.approx(50.0, rel=1e-3)
    assert "leave_out" in json.dumps(found["logs"])


def test_two_projects_at_once_are_refused_in_a_sentence(folder):
    done = run("identify", "--config", "a.toml", "--config=b.toml")
    assert done.exit_code == 2
    assert "--config is given twice" in done.stderr


def test_the_python_of_a_project_does_what_its_command_does(folder):
    options = {
        "model": "underwater-vehicle",
        "logs": ["swim.csv"],
        "method": "i-diransac",
        "settings": {"max_iterations": 20, "sample_size": 20},
        "from": 0.5,
        "despike": ["x_dot"],
        "fix": {"bias": 2.0},
    }
    project = Project.of(options, "test")
    space = {}
    exec(project.python().replace("print(result)", ""), space)
    run("identify", *project.words(), "-o", "cli.json")
    assert dr.Result.load("cli.json").parameters == space["result"].parameters


def test_every_stage_shows_a_command_that_the_command_line_takes(folder):
    write_swim(folder / "other.csv", 300, 5.0)
    run("identify", "swim.csv", "--model", "underwater-vehicle", "--method", "ols", "-o", "model.json")
    project = Project(model="underwater-vehicle", logs=["swim.csv"], held_out=["other.csv"], method="ols")
    for stage, shown in lines(project, ["model.json"]).items():
        words = shlex.split(shown["shell"])
        (folder / "diransac-results").mkdir(exist_ok=True)
        assert words[0] == "diransac"
        done = run(*words[1:])
        assert done.exit_code == 0, (stage, done.stderr)
        if stage != "solve":  # which has a test of its own
            exec(shown["python"], {})
    assert lines(Project(), [])["solve"]["shell"] == "diransac identify"
    assert lines(Project(), [])["check"]["shell"].startswith("# there is no log yet")


# ---------------------------------------------------------------------- logs


@pytest.mark.parametrize("n_rows", [50, 5000, 700_000])
@pytest.mark.parametrize(("begin", "end"), [(0.0, 1.0), (0.2, 0.7), (0.31, 0.3101), (-1.0, 2.0)])
def test_thinned_signals_keep_every_extreme(tmp_path, n_rows, begin, end):
    rng = np.random.default_rng(0)
    values = rng.standard_normal(n_rows)
    values[rng.random(n_rows) < 0.1] = np.nan
    values[n_rows // 2] = 99.0
    dr.Log.from_arrays(np.arange(n_rows) * 0.001, {"x": values}).write(tmp_path / "a.parquet")
    shown = Logs().read(tmp_path / "a.parquet", {})
    t = shown.log.time
    start, step, low, high = shown.window("x", begin * t[-1], end * t[-1], 200)
    assert len(low) == len(high) <= 2 * 200 + 600
    inside = values[(t >= begin * t[-1]) & (t <= end * t[-1])]
    if np.isfinite(inside).any():
        assert np.nanmin(low) <= np.nanmin(inside)
        assert np.nanmax(high) >= np.nanmax(inside)
    centres = start + step * np.arange(len(low))
    if begin < 0.5 < end:
        at = np.nanargmax(high)
        assert abs(centres[at] - t[n_rows // 2]) <= 0.5 * step + 1e-9


def test_outliers_are_those_of_the_reader_s_filter(tmp_path):
    t = np.arange(1000) * 0.01
    x = np.sin(t)
    x[::100] += 5.0
    dr.Log.from_arrays(t, {"x": x}).write(tmp_path / "a.csv")
    shown = Logs().read(tmp_path / "a.csv", {})
    times, values, total = shown.outliers("x", 2.0, 4.0)
    assert total == int(preprocessing.hampel(x)[0].sum())
    np.testing.assert_allclose(times, [2.0, 3.0, 4.0])
    assert (values > 3.0).all()


def test_a_mapping_that_does_not_fit_shows_the_file_s_own_columns(tmp_path):
    write_swim(tmp_path / "a.csv", 50)
    shown = Logs().read(tmp_path / "a.csv", {"rename": {"y": "absent"}})
    assert "absent" in shown.raw
    assert "x_dot" in shown.facts()["fields"]
    named = Logs().read(tmp_path / "a.csv", {"rename": {"speed": "x_dot"}}).facts()
    assert named["raw"] == ""
    assert {"x", "x_dot", "thrust"} <= set(named["fields"])


def test_a_recording_shows_its_fields_before_anything_is_mapped(tmp_path):
    write_mcap(tmp_path / "run.mcap")
    facts = Logs().read(tmp_path / "run.mcap", {}).facts()
    assert "no topic is mapped" in facts["raw"]
    assert "/joint_states.position[elbow]" in [x["name"] for x in facts["signals"]]
    named = Logs().read(tmp_path / "run.mcap", {"rename": {"x": "/joint_states.position[elbow]"}}).facts()
    assert [x["name"] for x in named["signals"]] == ["x"]
    assert "/command.u.force" in named["fields"]


def test_folders_are_those_that_were_given(tmp_path):
    (tmp_path / "a").mkdir()
    write_swim(tmp_path / "a/x.csv", 10)
    write_swim(tmp_path / "y.csv", 10)
    folders = Folders([tmp_path / "a/x.csv"])
    assert folders.first == tmp_path / "a"
    assert [x["name"] for x in folders.listed()["logs"]] == ["x.csv"]
    with pytest.raises(dr.LogError, match="below the folders"):
        folders.find("../y.csv")
    with pytest.raises(dr.LogError, match="does not exist"):
        Folders([tmp_path / "absent"])
    nested = Folders([tmp_path, tmp_path / "a"]).listed()["logs"]
    assert [x["name"] for x in nested] == ["y.csv", "a/x.csv"]


def test_a_dataset_is_one_log_of_which_the_first_episode_is_shown(tmp_path):
    angles = np.sin(0.1 * np.arange(100.0))[:, None] * [1.0, 2.0]
    write_dataset(tmp_path / "in" / "arm", [{"observation.state": angles}] * 2)
    for folders in (Folders([tmp_path / "in"]), Folders([tmp_path / "in/arm"])):
        assert [x["name"] for x in folders.listed()["logs"]] == ["arm"]
    assert Folders([tmp_path / "in/arm"]).files == (tmp_path / "in/arm",)
    shown = Logs().read(folders.find("arm"), {}).facts()
    assert "the first of 2 episodes is shown" in shown["notes"][0]


def test_a_browser_leaves_the_usual_port_out():
    assert hosts_of(8000) == ["127.0.0.1:8000", "localhost:8000"]
    assert "localhost" in hosts_of(80)


def test_names_that_the_command_line_would_take_for_others_are_refused():
    project = Project.of({"logs": ["a.csv"], "map": {"x": "pos,x"}}, "test")
    with pytest.raises(dr.SettingsError, match="comma"):
        project.words()


# ---------------------------------------------------------------------- views


def header(content):
    n = int.from_bytes(content[:4], "little")
    return json.loads(content[4 : 4 + n]), np.frombuffer(content[4 + n :], np.float32)


def test_a_built_in_machine_is_where_its_coordinates_are():
    pytest.importorskip("mujoco", reason="VIEWS NOT CHECKED: pip install 'diransac[robots]'")
    half = np.sqrt(0.5)
    columns = {"x": np.array([1.0]), "z": np.array([2.0]), "qw": np.array([half]), "qz": np.array([half])}
    head, numbers = header(_content("quadrotor", None, [], np.zeros(1), [columns]))
    places = numbers[-12 * len(head["shapes"]) :].reshape(-1, 12)
    np.testing.assert_allclose(places[0, 9:], [1.0, 0.0, 2.0], atol=1e-6)
    np.testing.assert_allclose(places[0, :9].reshape(3, 3) @ [1, 0, 0], [0.0, 1.0, 0.0], atol=1e-6)
    assert len(numbers) == 6 * sum(x["count"] for x in head["shapes"]) + 12 * len(head["shapes"])
    with pytest.raises(dr.ModelError, match="no drawing"):
        _content("bent", None, [], np.zeros(1), [{}])


def test_every_built_in_model_has_a_drawing():
    pytest.importorskip("mujoco", reason="VIEWS NOT CHECKED: pip install 'diransac[robots]'")
    for name in dr.models.BUILTIN:
        assert header(_content(name, None, [], np.zeros(1), [{}]))[0]["shapes"], name


def test_a_robot_moves_with_its_joints_and_takes_no_mesh_from_elsewhere(tmp_path):
    pytest.importorskip("mujoco", reason="VIEWS NOT CHECKED: pip install 'diransac[robots]'")
    text = urdf(0)
    (tmp_path / "arm.urdf").write_text(text)
    head, _ = header(_content("", str(tmp_path / "arm.urdf"), [str(tmp_path)], np.zeros(3), [{}, {}]))
    assert len(head["shapes"]) > 3
    visual = '<visual><geometry><mesh filename="../../etc/secret.stl"/></geometry></visual>'
    (tmp_path / "out.urdf").write_text(text.replace("</inertial>", f"</inertial>{visual}", 1))
    assert header(_content("", str(tmp_path / "out.urdf"), [str(tmp_path)], np.zeros(1), [{}]))[0]["shapes"]
    with pytest.raises(dr.ModelError):
        _content("", str(tmp_path / "absent.urdf"), [], np.zeros(1), [{}])


# ---------------------------------------------------------------------- jobs


def test_a_solve_goes_from_start_to_a_report_and_an_export(folder):
    write_swim(folder / "other.csv", 300, 5.0)
    client = Client(folder)
    try:
        client.post("api/project", {"model": "underwater-vehicle", "logs": ["swim.csv"], "method": "ols"})
        assert client.post("api/run", {"kind": "validate"}).status == 400
        assert client.post("api/run", {"kind": "solve"}).status == 200
        assert client.finished("solve").status == "done", client.studio.jobs.latest["solve"].error
        assert client.studio.state()["results"] == ["diransac-results/model.json"]
        shown = client.get("api/result?name=diransac-results/model.json").json()
        assert shown["parameters"]["mass"] == pytest.approx(50.0, rel=1e-3)
        assert set(shown["intervals_text"]) == set(shown["parameters"])
        report = client.get("api/report?kind=solve")
        assert report.headers["content-security-policy"].startswith("sandbox allow-scripts; default-src 'none'")
        assert "script-src 'sha256-" in report.headers["content-security-policy"]
        client.post("api/run", {"kind": "export", "name": "dynamics.c"})
        assert client.finished("export").status == "done"
        assert b"Runge" in client.get("api/download?name=dynamics.c").body
        assert not client.studio.state()["stale"]
        client.post("api/project", {"seed": 4})
        assert client.studio.state()["stale"]
    finally:
        client.close()


def test_terms_that_a_model_lacks_are_shown_and_added_by_a_click(folder):
    write_spring(folder / "spring.csv")
    client = Client(folder)
    try:
        client.post("api/project", {"model": "underwater-vehicle", "logs": ["spring.csv"], "fix": {"bias": 2.0}})
        client.post("api/run", {"kind": "solve"})
        assert client.finished("solve").status == "done", client.studio.jobs.latest["solve"].error
        shown = client.get("api/result?name=diransac-results/model.json").json()
        assert len(shown["changes"]) == len(shown["suggestions"]) > 0
        assert "x" in shown["changes"][0]
        name = shown["suggestions"][0]["parameter"]
        client.post("api/project", {"add-terms": [name]})
        assert f"--add-terms {name}" in client.studio.state()["commands"]["solve"]["shell"]
        assert f"with_suggestions=['{name}']" in client.studio.state()["commands"]["solve"]["python"]
        client.post("api/run", {"kind": "solve"})
        assert client.finished("solve").status == "done", client.studio.jobs.latest["solve"].error
        again = client.get("api/result?name=diransac-results/model.json").json()
        assert set(again["parameters"]) == {*shown["parameters"], name}
    finally:
        client.close()


def test_a_job_that_fails_says_why_and_one_that_is_aborted_ends(folder):
    (folder / "bad.csv").write_text("t,x\n0,1\n")
    client = Client(folder)
    try:
        client.post("api/project", {"model": "underwater-vehicle", "logs": ["bad.csv"]})
        client.post("api/run", {"kind": "check"})
        assert "bad.csv" in client.finished("check").error
        assert client.get("api/log?name=bad.csv").status == 400
        client.post("api/project", {"logs": ["swim.csv"]})
        client.post("api/run", {"kind": "solve"})
        client.post("api/stop", {"kind": "solve", "at_once": True})
        job = client.finished("solve")
        assert job.status == "stopped"
        assert job.process.returncode is not None
    finally:
        client.close()


def test_progress_for_programs_is_json_and_a_search_can_be_ended(folder):
    words = ["-m", "diransac", "identify", "swim.csv", "--model", "underwater-vehicle", "--progress-json", "--json"]
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    with subprocess.Popen([sys.executable, *words], text=True, **pipes) as process:
        steps = [json.loads(process.stderr.readline()) for _ in range(4)]
        process.stdin.write("stop\n")
        process.stdin.flush()
        out, rest = process.communicate(timeout=60)
    steps += [json.loads(line) for line in rest.splitlines()]
    assert process.returncode == 0
    assert [x["fraction"] for x in steps] == sorted(x["fraction"] for x in steps)
    assert any(x["parameters"].keys() == json.loads(out)["parameters"].keys() for x in steps)
    assert any("x" in x["residuals"] for x in steps)
    assert "time limit" in out or steps[-1]["stage"] == "done"


def test_a_search_that_is_ended_has_the_best_answer_so_far(folder, monkeypatch):
    monkeypatch.setattr(time_limit, "_ENDED", type(time_limit._ENDED)())
    seen = []

    def end(found):
        seen.append(found)
        if found.parameters:
            time_limit.end_search()

    t = np.arange(300) * 0.01
    noise = np.random.default_rng(0).standard_normal(300)
    log = dr.read_log("swim.csv").between(0.0, 2.99)
    log = dr.Log.from_arrays(t, {n: log[n] + 0.01 * noise * (n == "x_dot") for n in log.names})
    result = dr.identify(dr.models.underwater_vehicle(), log, progress=end)
    assert any("time limit" in str(x) for x in result.findings)
    assert seen[-1].stage == "done"
    monkeypatch.setattr(time_limit, "_ENDED", type(time_limit._ENDED)())
    time_limit.end_search()
    with pytest.raises(dr.TimeLimitError, match="ended before an answer"):
        dr.identify(dr.models.underwater_vehicle(), log)


def test_terms_that_nothing_suggests_are_named_and_not_added(folder):
    words = ["identify", "swim.csv", "--model", "underwater-vehicle", "--fix", "bias=2", "--add-terms", "nothing"]
    done = run(*words)
    assert "nothing suggests the terms nothing" in " ".join(done.stdout.split())


def test_what_several_logs_can_tell_is_inspected_together(folder):
    write_swim(folder / "other.csv", 300, 5.0)
    model, logs = dr.models.underwater_vehicle(), [dr.read_log("swim.csv"), dr.read_log("other.csv")]
    found = inspect(logs, model)
    alone = inspect(logs[0], model).fitness.excitation
    assert [x.n_rows for x in (found, *found.others)] == [len(log) for log in logs]
    assert any(found.fitness.excitation[name].estimate != x.estimate for name, x in alone.items())
    words = Project(model="underwater-vehicle", logs=["swim.csv", "other.csv"])
    shell = lines(words, [])["check"]["shell"]
    told = json.loads(run(*shlex.split(shell)[1:], "--json").stdout)
    assert told["others"][0]["source"] == found.others[0].source
    assert told["fitness"]["excitation"]["mass"]["estimate"] == found.fitness.excitation["mass"].estimate
    assert found.others[0].source in str(found)


def test_inspect_takes_known_parameters(folder):
    log, model = dr.read_log("swim.csv"), dr.models.underwater_vehicle()
    assert set(inspect(log, model, fixed={"mass": 50.0}).fitness.excitation) == set(model.parameters) - {"mass"}
    found = json.loads(run("inspect", "swim.csv", "--model", "underwater-vehicle", "--fix", "mass=50", "--json").stdout)
    assert "mass" not in found["fitness"]["excitation"]
    with pytest.raises(dr.SettingsError, match="without a model"):
        inspect(log, fixed={"mass": 50.0})


def is_alive(pid):
    """Whether a process runs; one that has ended may wait for somebody to ask for its code."""
    stat = Path(f"/proc/{pid}/stat")
    return stat.exists() and stat.read_text().rpartition(")")[2].split()[0] != "Z"


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="ENDS OF THE STUDIO NOT CHECKED: no /proc here")
@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 143), (signal.SIGKILL, -9)]
)
def test_the_server_ends_with_its_jobs_and_its_scenes_however_it_is_ended(folder, number, code):
    words = [sys.executable, "-m", "diransac", "studio", "swim.csv", "--port", "0", "--no-browser"]

    def begin():  # a shell's background jobs ignore them
        for ignored in (signal.SIGINT, signal.SIGHUP):
            signal.signal(ignored, signal.SIG_DFL)

    Path("own.py").write_text(
        "import subprocess, time\nfrom pathlib import Path\nchild = subprocess.Popen(['sleep', '60'])\n"
        "Path('part').write_text(str(child.pid))\nPath('part').rename('pid')\ntime.sleep(60)\n"
    )
    with subprocess.Popen(words, stderr=subprocess.PIPE, text=True, preexec_fn=begin) as server:
        address = server.stderr.readline().split()[0]
        assert address.startswith("http://127.0.0.1:")

        def ask(path, **body):
            request = urllib.request.Request(f"{address}{path}", json.dumps(body).encode() if body else None)
            request.add_header("content-type", "application/json")
            with urllib.request.urlopen(request) as answer:
                return answer.read()

        assert b"diransac studio" in ask("")
        ask("api/project", model="underwater-vehicle")
        ask("api/scene")
        ask("api/project", model="own.py")
        ask("api/confirm", name="own.py", sha256=json.loads(ask("api/code"))["sha256"])
        ask("api/run", kind="model")
        end = time.monotonic() + 20.0
        while time.monotonic() < end and not Path("pid").exists():
            time.sleep(0.02)
        of_threads = Path(f"/proc/{server.pid}/task").glob("*/children")
        started = [Path("pid").read_text(), *(child for x in of_threads for child in x.read_text().split())]
        server.send_signal(number)
        try:
            assert server.wait(10) == code
        finally:
            server.kill()
    end = time.monotonic() + 5.0
    while time.monotonic() < end and any(map(is_alive, started)):
        time.sleep(0.02)
    assert len(started) >= 3
    assert not [process for process in started if is_alive(process)]


def test_a_browser_is_given_a_private_file_and_not_the_token(folder, monkeypatch):
    from diransac.cli.commands import studio

    given = []

    def serve(_files, _port, tell):
        tell("http://127.0.0.1:8710/t0k3n/")
        for _ in range(100):
            if given:
                break
            time.sleep(0.02)
        file = Path(urllib.request.url2pathname(given[0].removeprefix("file://")))
        assert "t0k3n" in file.read_text()
        assert (file.stat().st_mode & 0o777, file.parent.stat().st_mode & 0o777) == (0o600, 0o700)
        given.append(file)

    monkeypatch.setattr("diransac.studio.serve", serve)
    monkeypatch.setattr(studio.webbrowser, "open", given.append)
    assert run("studio").exit_code == 0
    assert "t0k3n" not in given[0]
    assert not given[1].exists()


def test_a_taken_port_is_said(folder):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        done = run("studio", "--port", other.getsockname()[1], "--no-browser")
    assert done.exit_code == 1
    assert "is not free" in done.stderr
