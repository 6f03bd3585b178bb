"""Requests that must not reach the application of the studio, or not leave its folders."""

import asyncio
import hashlib
import os
import sys
import time
from pathlib import Path

import pytest

from diransac.errors import ModelError
from diransac.user_files import CONFIRMED, definitions

pytest.importorskip("starlette", reason="STUDIO NOT CHECKED: pip install 'diransac[studio]'")
from diransac.studio.jobs import Job, Jobs
from diransac.studio.project import Project
from studio_client import HOST, TOKEN, Client, write_swim

MODEL = "from pathlib import Path\nPath('ran').touch()\nimport diransac as dr\nmodel = dr.models.underwater_vehicle()\n"
NAMES = ["<script>alert(1)</script>", "x\u202egnp.exe", 'a"onclick="b', "a\x1b[2Jb"]
OF_OTHERS = [
    {"path": "/", "headers": {}},
    {"path": "/api/files", "headers": {}},
    {"path": f"/{TOKEN}", "headers": {}},
    {"path": "/wrong/", "headers": {}},
    {"path": f"/{TOKEN[:-1]}/", "headers": {}},
    {"path": f"/{TOKEN}x/", "headers": {}},
    {"path": f"//{TOKEN}/", "headers": {}},
    {"path": f"/static/../{TOKEN}/", "headers": {}},
    {"headers": {"host": "attacker.example:8710"}},
    {"headers": {"host": "127.0.0.1"}},
    {"headers": {"host": "127.0.0.1:8711"}},
    {"headers": {"host": ""}},
    {"headers": {"origin": "https://attacker.example"}},
    {"headers": {"origin": "http://127.0.0.1:8711"}},
    {"headers": {"origin": "http://127.0.0.1:8710.attacker.example"}},
    {"headers": {"origin": "null"}},
    {"headers": {"sec-fetch-site": "cross-site"}},
    {"headers": {"sec-fetch-site": "same-site"}},
    {"method": "POST", "body": {}, "headers": {"sec-fetch-site": "cross-site", "sec-fetch-mode": "navigate"}},
    {"kind": "websocket", "headers": {}},
    {"kind": "websocket", "headers": {"origin": "https://attacker.example"}},
]
OUTSIDE = [
    "../secret.csv",
    "/etc/passwd",
    "link.csv",
    "linked/secret.csv",
    "sub/../../secret.csv",
    "..\\secret.csv",
    "secret.csv\0",
    "a" * 5000,
    "~/secret.csv",
    "file:///etc/passwd",
]


@pytest.fixture
def client(tmp_path):
    """An application over a folder with links to a file outside of it."""
    folder = tmp_path / "given"
    folder.mkdir()
    write_swim(folder / "swim.csv", 50)
    write_swim(tmp_path / "secret.csv", 50)
    (folder / "link.csv").symlink_to(tmp_path / "secret.csv")
    (folder / "linked").symlink_to(tmp_path)
    (folder / "own.py").write_text(MODEL)
    found = Client(folder)
    yield found
    found.close()


@pytest.mark.parametrize("case", range(len(OF_OTHERS)))
def test_requests_of_others_are_refused(client, case):
    request = {"path": f"/{TOKEN}/api/files", **OF_OTHERS[case]}
    answer = client.ask(**request)
    assert answer.status == 403
    assert b"swim" not in answer.body
    assert "access-control-allow-origin" not in answer.headers


def test_the_page_itself_passes_and_may_be_opened_from_anywhere(client):
    assert client.get("").status == 200
    assert client.ask(f"/{TOKEN}/", headers={"origin": f"http://{HOST}", "sec-fetch-site": "same-origin"}).status == 200
    opened = {"sec-fetch-site": "cross-site", "sec-fetch-mode": "navigate"}
    assert client.ask(f"/{TOKEN}/", headers=opened).status == 200


@pytest.mark.parametrize("path", ["", "static/main.js", "api/files", "static/nothing.js"])
def test_every_answer_has_a_policy_without_inline_scripts(client, path):
    headers = client.get(path).headers
    policy = dict(part.strip().partition(" ")[::2] for part in headers["content-security-policy"].split(";"))
    assert policy["default-src"] == "'none'"
    assert policy["script-src"] == "'self'"
    assert policy["frame-ancestors"] == policy["style-src"] == "'self'"
    assert headers["x-content-type-options"] == "nosniff"
    assert headers["referrer-policy"] == "no-referrer"
    assert b"<script>" not in client.get("").body
    assert b"style=" not in client.get("").body


@pytest.mark.parametrize("name", OUTSIDE)
def test_files_outside_of_the_folders_are_neither_read_nor_used(client, name):
    from urllib.parse import quote

    for path in (f"api/log?name={quote(name)}", f"api/series?name={quote(name)}&signal=x&begin=0&end=1&width=9"):
        answer = client.get(path)
        assert answer.status == 400
        assert b"there is no such file below the folders" in answer.body
    for change in ({"logs": [name]}, {"held-out": [name]}, {"mapping": f"{name}.toml"}, {"model": f"{name}.urdf"}):
        assert client.post("api/project", change).status == 400
    assert client.post("api/run", {"kind": "check", "log": name}).status == 400
    assert client.studio.project.options == {}


@pytest.mark.parametrize("path", ["static/../app.py", "static/%2e%2e/app.py", "static/app.py", "static//etc/passwd"])
def test_nothing_but_the_page_is_static(client, path):
    assert client.get(path).status == 404


def test_downloads_are_those_of_results_alone(client, tmp_path):
    results = tmp_path / "given/diransac-results"
    results.mkdir()
    (results / "dynamics.c").write_text("int x;")
    (results / "out.csv").symlink_to(tmp_path / "secret.csv")
    found = client.get("api/download?name=dynamics.c")
    assert found.body == b"int x;"
    assert "attachment" in found.headers["content-disposition"]
    assert client.get("api/download?name=out.csv").status == 400
    assert client.get("api/download?name=../swim.csv").status == 400


@pytest.mark.parametrize("chunks", [[b"x" * (1 << 21)], [b"x" * (1 << 19)] * 3])
@pytest.mark.parametrize("honest", [True, False])
def test_a_large_body_is_refused(client, chunks, honest):
    length = {"content-length": str(sum(map(len, chunks)))} if honest else {}
    headers = {"content-type": "application/json", **length}
    assert client.ask(f"/{TOKEN}/api/project", method="POST", chunks=chunks, headers=headers).status == 413


@pytest.mark.parametrize(
    ("body", "kind"),
    [
        (b"{", "application/json"),
        (b"[]", "application/json"),
        (b'{"model": "x"}', "text/plain"),
        (b"[" * 10_000, "application/json"),
    ],
)
def test_a_body_that_is_no_json_object_is_refused(client, body, kind):
    answer = client.ask(f"/{TOKEN}/api/project", method="POST", chunks=[body], headers={"content-type": kind})
    assert answer.status == 400


@pytest.mark.parametrize(
    "change", [{"output": "x"}, {"logs": "swim.csv"}, {"leave-out": [[0]]}, {"settings": {"a": []}}]
)
def test_a_project_takes_options_of_identify_alone(client, change):
    assert client.post("api/project", change).status == 400


@pytest.mark.parametrize("name", ["../a.c", "a/b.c", "/tmp/a.c", "-o", "a.c\n", ""])
def test_exports_stay_in_their_folder(client, tmp_path, name):
    (tmp_path / "given/diransac-results").mkdir()
    (tmp_path / "given/diransac-results/model.json").write_text("{}")
    assert client.post("api/run", {"kind": "export", "name": name}).status == 400


def test_own_code_runs_once_it_is_confirmed_by_name_and_content(client, tmp_path):
    ran = tmp_path / "given/ran"
    assert client.post("api/project", {"model": "own.py", "logs": ["swim.csv"]}).status == 200
    for kind in ("model", "check", "map", "design", "solve"):
        answer = client.post("api/run", {"kind": kind})
        assert answer.status == 400
        assert b"own.py is a program" in answer.body
    assert client.post("api/project", {"model": "own.py:other"}).status == 200
    assert client.post("api/run", {"kind": "model"}).status == 400
    client.post("api/project", {"model": "own.py"})
    shown = client.get("api/code").json()
    assert shown["text"] == MODEL
    (tmp_path / "given/own.py").write_text(f"{MODEL}# changed\n")
    assert client.post("api/confirm", {"name": "own.py", "sha256": shown["sha256"]}).status == 400
    shown = client.get("api/code").json()
    assert not ran.exists()
    assert client.post("api/confirm", {"name": "own.py", "sha256": shown["sha256"]}).status == 200
    assert client.post("api/run", {"kind": "model"}).status == 200
    job = client.finished("model")
    assert (job.status, job.printed["name"]) == ("done", "underwater-vehicle")
    assert ran.exists()
    (tmp_path / "given/own.py").write_text(f"{MODEL}# changed again\n")
    assert client.post("api/run", {"kind": "model"}).status == 400


@pytest.mark.parametrize("name", ["a.py.py", "lib.pyx/own.py", "own.py:x.py", "own.py:x.py:model"])
def test_code_runs_once_it_is_confirmed_however_its_file_is_called(client, tmp_path, name):
    file = tmp_path / "given" / name.removesuffix(":model")
    file.parent.mkdir(exist_ok=True)
    file.write_text(MODEL)
    assert client.post("api/project", {"model": name, "logs": ["swim.csv"]}).status == 200
    for kind in ("model", "check", "map", "design", "solve"):
        assert b"is a program" in client.post("api/run", {"kind": kind}).body
    assert client.studio.jobs.latest == {}
    assert client.studio.state()["code"]["name"] == name.removesuffix(":model")


def confirmed(client, model="own.py"):
    """The client's project with a model of its own, which is confirmed."""
    client.post("api/project", {"model": model, "logs": ["swim.csv"], "method": "ols"})
    shown = client.get("api/code").json()
    assert client.post("api/confirm", {"name": shown["name"], "sha256": shown["sha256"]}).status == 200
    return shown


def test_code_that_changes_after_its_confirmation_does_not_run(client, tmp_path, monkeypatch):
    confirmed(client)
    (tmp_path / "given/own.py").write_text(MODEL + "# changed")
    monkeypatch.setattr(client.studio, "code", lambda: ("own.py", hashlib.sha256(MODEL.encode()).hexdigest()))
    assert client.post("api/run", {"kind": "model"}).status == 200
    job = client.finished("model")
    assert (job.status, "not the program that was confirmed" in job.error) == ("failed", True)
    assert not (tmp_path / "given/ran").exists()


def test_a_project_that_changes_after_a_confirmation_is_not_what_is_solved(client, tmp_path):
    (tmp_path / "given/evil.py").write_text(MODEL)
    client.post("api/project", {"model": "underwater-vehicle", "logs": ["swim.csv"], "method": "ols"})
    client.post("api/run", {"kind": "solve"})
    client.studio.file.write_text('model = "evil.py"\nlogs = ["swim.csv"]\nmethod = "ols"\n')
    client.finished("solve")
    assert "--config" not in client.studio.jobs.latest["solve"].words
    assert not (tmp_path / "given/ran").exists()


def test_confirmed_code_is_a_module_while_it_runs(tmp_path, monkeypatch):
    file = tmp_path / "own.py"
    file.write_text("import sys\nown = sys.modules[__name__].__file__\n")
    monkeypatch.setenv(CONFIRMED, hashlib.sha256(file.read_bytes()).hexdigest())
    assert definitions(file, "model")["own"] == str(file)
    assert "diransac_model_file" not in sys.modules
    monkeypatch.setenv(CONFIRMED, "")
    with pytest.raises(ModelError, match="not the program that was confirmed"):
        definitions(file, "model")


def test_code_too_long_to_be_shown_is_not_confirmed(client, tmp_path):
    for size in (100_001, 1_000_000):
        (tmp_path / "given/own.py").write_text("#" * size)
        client.post("api/project", {"model": "own.py"})
        answer = client.get("api/code")
        assert answer.status == 400
        assert b"more than 100,000 characters" in answer.body
        assert client.post("api/confirm", {"name": "own.py", "sha256": ""}).status == 400


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"# -*- coding: latin-1 -*-\nx = '\xe9'\r", "x = '\u00e9'\n"),
        (b"\xef\xbb\xbfx = '\xc3\xa9'", "x = '\u00e9'"),
        (b"# coding: utf-7\n+AG8-pen('ran')", "\nopen('ran')"),
        (b"# coding: rot13\n", ""),
        (b"# coding: nothing\n", ""),
        (b"x = '\xe9'", ""),
    ],
)
def test_code_is_shown_as_python_reads_it_and_otherwise_not_confirmed(client, tmp_path, content, said):
    (tmp_path / "given/own.py").write_bytes(content)
    client.post("api/project", {"model": "own.py"})
    answer = client.get("api/code")
    if said:
        assert said in answer.json()["text"]
        assert answer.json()["sha256"] == hashlib.sha256(content).hexdigest()
    else:
        assert b"Python cannot read own.py" in answer.body
        assert client.studio.code() == ("own.py", "")


def test_a_pipe_in_place_of_code_is_not_waited_for(client, tmp_path):
    os.mkfifo(tmp_path / "given/pipe.py")
    client.post("api/project", {"model": "pipe.py"})
    assert client.studio.state()["code"] == {"name": "pipe.py", "sha256": "", "confirmed": False}


def test_code_is_read_again_only_once_it_has_changed(client, tmp_path, monkeypatch):
    client.post("api/project", {"model": "own.py"})
    first = client.studio.code()
    monkeypatch.setattr("diransac.studio.app.read_bytes", lambda *_: pytest.fail("it is read again"))
    assert client.studio.code() == first


@pytest.mark.parametrize("whole", [True, False])
def test_results_are_not_written_through_links(client, tmp_path, whole):
    (tmp_path / "else").mkdir()
    results = tmp_path / "given/diransac-results"
    if not whole:
        results.mkdir()
    (results if whole else results / "report.html").symlink_to(tmp_path / "else")
    client.post("api/project", {"model": "underwater-vehicle", "logs": ["swim.csv"]})
    answer = client.post("api/run", {"kind": "solve"})
    assert (answer.status, b"has a link" in answer.body) == (400, True)
    assert not list((tmp_path / "else").iterdir())


@pytest.mark.parametrize("name", ["../secret.TOML", "../secret.cfg", "/etc/passwd", "secret", "sub/../../secret.csv"])
def test_a_mapping_is_built_in_or_below_the_folders_whatever_its_ending(client, tmp_path, name):
    assert client.post("api/project", {"mapping": name}).status == 400
    assert client.post("api/project", {"mapping": "px4-multirotor"}).status == 200
    client.studio.project = client.studio.project.changed({"mapping": name})
    assert b"no such file below the folders" in client.get("api/log?name=swim.csv").body


def test_a_folder_with_a_link_that_leaves_the_folders_is_no_log(client, tmp_path):
    bag = tmp_path / "given/bag"
    bag.mkdir()
    write_swim(bag / "part.csv", 50)
    (bag / "inside.csv").symlink_to(tmp_path / "given/swim.csv")
    assert client.studio.folders.find("bag") == bag
    (bag / "secret.csv").symlink_to(tmp_path / "secret.csv")
    assert b"is a link that leaves it" in client.get("api/log?name=bag").body
    assert client.post("api/project", {"logs": ["bag"]}).status == 400


@pytest.mark.parametrize(
    "text",
    [
        '<mujoco><include file="../secret.xml"/></mujoco>',
        '<mujoco><include file="parts/inner.xml"/></mujoco>',
        '<mujoco><include file="link.xml"/></mujoco>',
        '<mujoco a="1" a="2"><include file="../secret.xml"/></mujoco>',
        '<mujoco><asset><model name="m" file="../secret.xml"/></asset></mujoco>',
    ],
)
def test_descriptions_take_in_others_from_below_the_folders_alone(client, tmp_path, text):
    (tmp_path / "secret.xml").write_text("<mujoco/>")
    (tmp_path / "given/link.xml").symlink_to(tmp_path / "secret.xml")
    (tmp_path / "given/parts").mkdir()
    (tmp_path / "given/parts/inner.xml").write_text('<mujoco><include file="../secret.xml"/></mujoco>')
    (tmp_path / "given/arm.xml").write_text("<mujoco/>")
    assert client.post("api/project", {"model": "arm.xml"}).status == 200
    (tmp_path / "given/arm.xml").write_text(text)
    assert client.post("api/run", {"kind": "model"}).status == 400
    assert client.studio.jobs.latest == {}
    assert client.get("api/scene").status == 400


def test_names_in_the_shown_python_are_no_code():
    evil = "kp=__import__('os').abort(), kd"
    options = {"model": "arm.urdf", "control": {evil: 1.0, "kp": 2.0}}
    assert f"**{ {evil: 1.0}!r}, kp=2.0" in Project.of(options, "test").python()
    for model in ("own.py:model; import os", "a b.py", "a.b.py", "own.py:x.py"):
        lines = Project.of({"model": model}, "test").python().split("\n")
        assert not [x for x in lines if x.startswith(("from", "import")) and x != "import diransac as dr"]
    assert "from own import other as model" in Project.of({"model": "sub/own.py:other"}, "test").python()


@pytest.mark.parametrize("name", ["a\0b", "a\nb", "a\x1b[2J"])
def test_names_of_a_stage_have_no_control_characters(client, name):
    client.post("api/project", {"model": "underwater-vehicle"})
    answer = client.post("api/run", {"kind": "design", "limits": {name: [0, 1]}})
    assert b"control characters" in answer.body


def test_a_command_that_cannot_be_started_is_not_running(client):
    client.post("api/project", {"model": "underwater-vehicle"})
    assert client.post("api/run", {"kind": "design", "limits": {"a" * 200_000: [0, 1]}}).status == 400
    assert client.studio.jobs.latest == {}


def test_an_empty_line_does_not_hide_what_a_command_says_later():
    async def said():
        stream = asyncio.StreamReader()
        stream.feed_data(b"Traceback\n\nRealError: reason\n")
        stream.feed_eof()
        return await Jobs(Path(), lambda: None)._progress(Job([], 1), stream)

    assert asyncio.run(said()) == ["Traceback", "RealError: reason"]


def test_what_a_program_has_started_ends_with_its_job(client, tmp_path):
    pid = tmp_path / "given/pid"
    (tmp_path / "given/own.py").write_text(
        "import subprocess, time\nfrom pathlib import Path\nchild = subprocess.Popen(['sleep', '60'])\n"
        "Path('part').write_text(str(child.pid))\nPath('part').rename('pid')\ntime.sleep(60)\n"
    )
    confirmed(client)
    client.post("api/run", {"kind": "model"})
    for _ in range(500):
        if pid.exists():
            break
        time.sleep(0.02)
    client.post("api/stop", {"kind": "model", "at_once": True})
    assert client.finished("model").status == "stopped"
    time.sleep(0.2)
    stat = Path(f"/proc/{pid.read_text()}/stat")
    assert not stat.exists() or stat.read_text().rpartition(")")[2].split()[0] == "Z"


@pytest.mark.parametrize(
    "path", ["download?name=", "download?name=sub", "series?name=swim.csv&signal=x&begin=inf&end=1&width=9"]
)
def test_odd_requests_are_answered_by_a_sentence(client, tmp_path, path):
    (tmp_path / "given/diransac-results/sub").mkdir(parents=True)
    answer = client.get(f"api/{path}")
    assert answer.status == 400
    assert answer.json()["error"]


def test_a_module_beside_the_logs_is_not_imported(client, tmp_path):
    (tmp_path / "given/casadi.py").write_text("open('ran', 'w')")
    client.post("api/project", {"model": "underwater-vehicle"})
    client.post("api/run", {"kind": "model"})
    assert client.finished("model").status == "done"
    assert not (tmp_path / "given/ran").exists()


@pytest.mark.parametrize("name", NAMES)
def test_names_of_files_and_signals_are_data_in_every_answer(client, tmp_path, name):
    file = name.replace("/", "_") + ".csv"
    (tmp_path / "given" / file).write_text(f't,"{name.replace(chr(34), chr(34) * 2)}"\n0,1\n1,2\n2,1\n')
    answer = client.get("api/files")
    assert answer.headers["content-type"] == "application/json"
    assert file in [x["name"] for x in answer.json()["logs"]]
    assert "\x1b" not in answer.body.decode()
    assert "\u202e" not in answer.body.decode()
    assert client.post("api/project", {"logs": [file]}).status == 200
    state = client.studio.state()
    assert all(text.isprintable() for text in state["commands"]["data"]["shell"].split("\n"))
    assert "\x1b" not in os.fsdecode(client.studio.file.read_bytes())
