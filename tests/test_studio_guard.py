"""Requests that must not reach the application of the studio, or not leave its folders."""

import os

import pytest

pytest.importorskip("starlette", reason="STUDIO NOT CHECKED: pip install 'diransac[studio]'")
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
