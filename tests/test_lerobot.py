"""LeRobot datasets of both formats: an episode is a log, and features are columns by the names of their numbers."""

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import diransac as dr
from command_line import run
from diransac.data.readers import episodes_of, table
from lerobot_datasets import DATA_PATHS, JOINTS, write_dataset

STATE, ACTION = "observation.state", "action"
RNG = np.random.default_rng(0)
EPISODES = [
    {STATE: RNG.normal(size=(n, 2)), ACTION: RNG.normal(size=(n, 2)), "next.reward": RNG.normal(size=n)}
    for n in (40, 50, 60)
]


@pytest.fixture(params=DATA_PATHS)
def dataset(tmp_path, request):
    return write_dataset(tmp_path / "pusht", EPISODES, version=request.param)


def single(values):
    return values.astype(np.float32).astype(np.float64)


def test_every_episode_is_a_log_with_the_numbers_that_were_written(dataset):
    logs = dr.read_logs(dataset)
    assert episodes_of(dataset) == (0, 1, 2)
    for k, (log, written) in enumerate(zip(logs, EPISODES, strict=True)):
        assert log.source == f'log "{dataset}", episode {k}'
        np.testing.assert_array_equal(log.time, np.arange(len(log)) / 30)
        for i, joint in enumerate(JOINTS):
            np.testing.assert_array_equal(log[f"{STATE}.{joint}"], single(written[STATE][:, i]))
            np.testing.assert_array_equal(log[f"{ACTION}.{joint}"], single(written[ACTION][:, i]))
        np.testing.assert_array_equal(log["next.reward"], single(written["next.reward"]))
        assert len(log.names) == 5
        assert log.history[0] == {
            "step": "episode",
            "episode": k,
            "format": json.loads((dataset / "meta" / "info.json").read_text())["codebase_version"],
            "robot": "so101_follower",
        }
        assert log.notes == ()


def test_one_episode_is_chosen_by_its_number(dataset):
    log = dr.read_log(dataset, episode=1, rename={"elbow": f"{STATE}.elbow_flex.pos"}, scale={"elbow": 0.5})
    np.testing.assert_array_equal(log["elbow"], 0.5 * single(EPISODES[1][STATE][:, 1]))
    assert [len(x) for x in dr.read_logs(dataset, episodes=[2, 0])] == [60, 40]
    with pytest.raises(dr.LogError, match=r"it has 3 episodes, 0 to 2; choose one .*episode=0"):
        dr.read_log(dataset)
    with pytest.raises(dr.LogError, match="there is no episode 3; found 3 episodes, 0 to 2"):
        dr.read_log(dataset, episode=3)
    with pytest.raises(dr.LogError, match="each once"):
        dr.read_logs(dataset, episodes=[0, 0])
    with pytest.raises(dr.LogError, match="CSV text without a header"):
        dr.read_log(dataset, episode=0, columns=["t", "x"])


def test_a_dataset_of_one_episode_is_one_log(tmp_path):
    folder = write_dataset(tmp_path / "one", EPISODES[:1])
    log = dr.read_log(folder)
    assert (len(log), log.source) == (40, f'log "{folder}"')


def test_other_logs_have_no_episodes(tmp_path):
    log = dr.Log.from_arrays(np.arange(9.0), {"x": np.arange(9.0)})
    log.write(tmp_path / "a.csv")
    assert [x.names for x in dr.read_logs(tmp_path / "a.csv")] == [("x",)]
    assert episodes_of(tmp_path / "a.csv") == ()
    for read in (
        lambda: dr.read_log(tmp_path / "a.csv", episode=0),
        lambda: dr.read_logs(tmp_path / "a.csv", episodes=[0]),
    ):
        with pytest.raises(dr.LogError, match="one log without episodes"):
            read()


@pytest.mark.parametrize(
    ("names", "columns"),
    [
        ({"motors": ["pan", "flex"]}, ["action.pan", "action.flex"]),
        ({"left": ["pan"], "right": ["flex"]}, ["action.pan", "action.flex"]),
        ([["pan", "flex"]], ["action.pan", "action.flex"]),
        (None, ["action[0]", "action[1]"]),
        (["dim"], ["action[0]", "action[1]"]),
        (["gripper", "gripper"], ["action[0]", "action[1]"]),
        ([1, 2], ["action[0]", "action[1]"]),
        ("ab", ["action[0]", "action[1]"]),
        ({"motors": {"pan": 1}}, ["action[0]", "action[1]"]),
        (["", "x"], ["action[0]", "action[1]"]),
        (["a\nb", "x"], [r"action.a\u000ab", "action.x"]),
    ],
)
def test_numbers_have_their_names_or_their_index(tmp_path, names, columns):
    folder = write_dataset(tmp_path / "named", [{ACTION: EPISODES[0][ACTION]}], names=names)
    assert list(dr.read_log(folder).names) == columns


def test_lists_of_any_storage_are_read(tmp_path):
    """Lists, lists of fixed length, null rows and numbers; features of one number, and those that are no numbers."""
    folder = write_dataset(tmp_path / "kinds", [{ACTION: EPISODES[0][ACTION]}])
    values = [[1.0, 2.0], None, [3.0, None]] + [[4.0, 5.0]] * 37
    file = folder / "data" / "chunk-000" / "episode_000000.parquet"
    table = pq.read_table(file)
    table = table.append_column("plain", pa.array(values, pa.list_(pa.float32())))
    table = table.append_column("fixed", pa.array(values, pa.list_(pa.float64(), 2)))
    table = table.append_column("whole", pa.array([[k] for k in range(40)], pa.list_(pa.int64())))
    table = table.append_column("ragged", pa.array([[1.0] * (k % 2 + 1) for k in range(40)]))
    table = table.append_column("task", pa.array(["fold"] * 40))
    pq.write_table(table, file)
    log = dr.read_log(folder)
    for name in ("plain", "fixed"):
        np.testing.assert_array_equal(log[f"{name}[0]"][:4], [1.0, np.nan, 3.0, 4.0])
        np.testing.assert_array_equal(log[f"{name}[1]"][:4], [2.0, np.nan, np.nan, 5.0])
    np.testing.assert_array_equal(log["whole"], np.arange(40.0))
    assert log.unusable["ragged"].startswith("has 1 to 2 numbers in a row")
    assert log.unusable["task"] == "holds no short lists of numbers (String)"


@pytest.mark.parametrize("fps", [30, 29.97, None, 0, "30", 1e300, True, [30]])
def test_stamps_are_those_of_the_rate_where_both_agree(tmp_path, fps):
    folder = edited(write_dataset(tmp_path / "rate", EPISODES[:1]), fps=fps)
    time = dr.read_log(folder).time
    np.testing.assert_allclose(time, np.arange(40) / 30, atol=1e-6)
    assert np.array_equal(time, np.arange(40) / 30) == (fps == 30)


def test_without_stamps_the_rate_gives_the_time(tmp_path):
    folder = write_dataset(tmp_path / "clock", EPISODES[:1])
    file = folder / "data" / "chunk-000" / "episode_000000.parquet"
    table = pq.read_table(file).drop_columns(["timestamp", "frame_index"])
    pq.write_table(table, file)
    np.testing.assert_array_equal(dr.read_log(folder).time, np.arange(40) / 30)


def test_lost_frames_are_gaps(tmp_path):
    folder = write_dataset(tmp_path / "gaps", EPISODES[:1])
    file = folder / "data" / "chunk-000" / "episode_000000.parquet"
    table = pq.read_table(file)
    pq.write_table(table.take(np.delete(np.arange(40), [7, 8])), file)
    log = dr.read_log(folder)
    assert np.flatnonzero(np.isnan(log["next.reward"])).tolist() == [7, 8]


def test_the_built_in_mapping_names_joints_and_targets(dataset):
    log = dr.read_logs(dataset, mapping="lerobot")[0]
    assert log.names == ("shoulder_pan", "elbow_flex", "shoulder_pan_target", "elbow_flex_target")
    np.testing.assert_array_equal(log["elbow_flex_target"], single(EPISODES[0][ACTION][:, 1]))
    assert log.notes == ()


def test_an_unnamed_state_needs_a_mapping_of_its_own(tmp_path):
    folder = write_dataset(tmp_path / "unnamed", EPISODES[:1], names=None)
    with pytest.raises(dr.LogError, match=r'"lerobot" fits none of its columns; found t, observation.state\[0\]'):
        dr.read_log(folder, mapping="lerobot")


# Hostile datasets -----------------------------------------------------------------------------------------------------


def edited(folder: Path, **info: object) -> Path:
    path = folder / "meta" / "info.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | info))
    return folder


def linked(folder: Path, inside: str) -> None:
    """Move a file out of the dataset, and put a link in its place."""
    outside = folder.parent / "elsewhere"
    outside.mkdir()
    shutil.move(folder / inside, outside / "file")
    (folder / inside).symlink_to(outside / "file")


def first_file(folder: Path) -> Path:
    return sorted((folder / "data" / "chunk-000").iterdir())[0]


def truncate(folder: Path) -> None:
    first_file(folder).write_bytes(first_file(folder).read_bytes()[:-100])


def with_column(folder: Path, name: str, values: object) -> None:
    table = pq.read_table(first_file(folder))
    table = table.drop_columns([name]) if name in table.column_names else table
    pq.write_table(table.append_column(name, pa.array(values)), first_file(folder))


HOSTILE = {
    "no JSON": (lambda x: (x / "meta/info.json").write_text("{"), "is not JSON that can be read"),
    "a list": (lambda x: (x / "meta/info.json").write_text("[]"), "no dataset of LeRobot"),
    "no version": (lambda x: edited(x, codebase_version=None), "no dataset of LeRobot"),
    "an old version": (lambda x: edited(x, codebase_version="v1.6"), "format v1.6; formats v2.0 to v3.0 are read"),
    "a long version": (
        lambda x: edited(x, codebase_version="v3." + "9" * 10**5),
        "format v3.9{17}; formats",
    ),
    "a huge number": (lambda x: (x / "meta/info.json").write_text("9" * 10**4), "thousands of digits"),
    "a large file": (lambda x: (x / "meta/info.json").write_text(" " * 2**21), "it has 2 MiB; up to 1"),
    "a pipe": (lambda x: ((x / "meta/info.json").unlink(), os.mkfifo(x / "meta/info.json")), "not an ordinary file"),
    "no data": (lambda x: shutil.rmtree(x / "data"), r"there is no episode in data/chunk-\*/"),
    "data are a file": (lambda x: (shutil.rmtree(x / "data"), (x / "data").write_text("")), "there is no episode"),
    "cut off": (truncate, "is cut off"),
    "no Parquet": (lambda x: first_file(x).write_bytes(b"\0" * 99), "is not a Parquet file"),
    "a link to a file": (lambda x: linked(x, f"data/chunk-000/{first_file(x).name}"), "is a link out of the folder"),
    "a link to a folder": (lambda x: linked(x, "data/chunk-000"), "is a link out of the folder"),
    "a link to the facts": (lambda x: linked(x, "meta/info.json"), '"meta/info.json" is a link out of the folder'),
    "one episode twice": (
        lambda x: shutil.copy(first_file(x), first_file(x).with_name("episode_0.parquet")),
        '"episode_0.parquet" and ".*" both have episode 0; remove one',
    ),
    "one name twice": (lambda x: with_column(x, f"{STATE}.elbow_flex.pos", np.zeros(40)), "2 columns are called"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_a_hostile_dataset_is_refused_in_one_sentence(tmp_path, case):
    damage, says = HOSTILE[case]
    folder = write_dataset(tmp_path / "bad", EPISODES[:1])
    damage(folder)
    with pytest.raises(dr.LogError, match=says) as refused:
        dr.read_log(folder)
    assert str(refused.value).startswith(f'log "{folder}": ')
    assert "\n" not in str(refused.value)


def test_numbers_in_lists_are_counted_before_they_are_read(tmp_path, monkeypatch):
    """A row may have any number of them, which take a few bytes; the footer of the file has the count."""
    folder = write_dataset(tmp_path / "long", EPISODES[:1])
    pq.write_table(pa.table({"a": [[0.0] * 5000], "s": ["x"], "m": [{"k": [1, 2]}]}), first_file(folder))
    monkeypatch.setattr(table, "MOST_NUMBERS", 5002)
    for read in (lambda: dr.read_log(folder), lambda: dr.read_log(first_file(folder))):
        with pytest.raises(dr.LogError, match="5,003 numbers; up to 5,002 are possible"):
            read()


@pytest.mark.parametrize(
    ("values", "says"),
    [
        (np.zeros(90), "no whole numbers in a column episode_index"),
        ([None] + [1] * 89, "rows without a number"),
        (np.full(90, -1), "rows without a number"),
        (["0"] * 90, "no whole numbers"),
    ],
)
def test_episodes_of_a_shared_file_are_whole_numbers(tmp_path, values, says):
    folder = write_dataset(tmp_path / "bad", EPISODES[:2], version="v3.0")
    with_column(folder, "episode_index", values)
    with pytest.raises(dr.LogError, match=says):
        dr.read_logs(folder)


@pytest.mark.parametrize(
    "info",
    [
        {"data_path": "../../../etc/{episode_index}"},
        {"data_path": "{episode_index.__class__.__mro__}"},
        {"data_path": "{episode_index:0999999999d}"},
        {"total_episodes": 10**18, "total_frames": -1, "chunks_size": 0},
        {"features": 3},
        {"features": {ACTION: 3, STATE: {"names": 5, "shape": "x"}}},
        {"features": {STATE: {"shape": [10**18, 10**18]}}},
        {"robot_type": {"a": 1}},
    ],
)
def test_no_path_and_no_number_is_taken_from_the_facts(tmp_path, info):
    folder = edited(write_dataset(tmp_path / "odd", EPISODES[:1]), **info)
    log = dr.read_log(folder)
    assert len(log) == 40
    np.testing.assert_array_equal(log["next.reward"], single(EPISODES[0]["next.reward"]))


def test_links_of_the_hubs_cache_are_followed(tmp_path):
    """Its snapshots are folders of links to files in ``blobs``, beside ``snapshots``."""
    folder = write_dataset(tmp_path / "datasets--a--b" / "snapshots" / "0123", EPISODES[:1])
    blobs = tmp_path / "datasets--a--b" / "blobs"
    blobs.mkdir()
    for k, file in enumerate([x for x in folder.rglob("*") if x.is_file()]):
        shutil.move(file, blobs / str(k))
        file.symlink_to(os.path.relpath(blobs / str(k), file.parent))
    assert len(dr.read_log(folder)) == 40


# Commands -------------------------------------------------------------------------------------------------------------
RATE = 100


def axis(seed: int) -> dict[str, np.ndarray]:
    """Position, and the force of a current, of an axis of 20 kg."""
    t, rng = np.arange(1500) / RATE, np.random.default_rng(seed)
    phase = rng.uniform(0.0, 6.0, 2)
    x = np.sin(1.3 * t + phase[0]) + 0.4 * np.sin(4.0 * t + phase[1])
    v = 1.3 * np.cos(1.3 * t + phase[0]) + 1.6 * np.cos(4.0 * t + phase[1])
    a = -1.69 * np.sin(1.3 * t + phase[0]) - 6.4 * np.sin(4.0 * t + phase[1])
    force = 20.0 * a + 30.0 * v + 5.0 * np.sign(v)
    return {STATE: np.rad2deg(x)[:, None] * np.ones(2), ACTION: force[:, None] * np.ones(2)}


SIGNALS = ["--map", f"position={STATE}.shoulder_pan.pos,force={ACTION}.shoulder_pan.pos"]
AXIS = ["--model", "servo-axis", *SIGNALS, "--scale", "position=0.017453292519943295"]
AXIS += ["--method", "ols", "--differentiate"]


@pytest.fixture
def arm(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_dataset(Path("arm"), [axis(k) for k in range(3)], fps=RATE, version="v3.0")
    return tmp_path


def test_commands_take_the_folder_and_episodes_of_it(arm):
    done = run("identify", "arm", *AXIS, "--episodes", "0:2", "-o", "arm.json", "--json")
    assert done.exit_code == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["parameters"]["mass"] == pytest.approx(20.0, rel=0.02)
    assert [x["source"] for x in found["logs"]] == ['log "arm", episode 0', 'log "arm", episode 1']
    validated = json.loads(run("validate", "arm.json", "arm", "--episodes", "2", "--json").stdout)
    assert validated["rmse"]["position"] < 0.05
    assert run("predict", "arm.json", "arm", "--episodes", "2", "-o", "p.csv").exit_code == 0
    everything = json.loads(run("identify", "arm", *AXIS, "--json").stdout)
    assert len(everything["logs"]) == 3


def test_inspect_shows_the_first_episode_or_the_chosen_one(arm):
    text = run("inspect", "arm").stdout
    assert 'log "arm", episode 0: 1500 rows at 100 Hz' in text
    assert "the first of 3 episodes, 0 to 2; --episodes names another one" in text
    chosen = run("inspect", "arm", "--episodes", "1", "--mapping", "lerobot").stdout
    assert 'log "arm", episode 1' in chosen
    assert "shoulder_pan_target" in chosen


def test_a_first_guess_of_a_mapping_has_the_columns(arm):
    text = run("map", "arm", "--model", "servo-axis").stdout
    assert f"{STATE}.shoulder_pan.pos" in text


@pytest.mark.parametrize(
    ("command", "says"),
    [
        (["predict", "arm.json", "arm", "-o", "p.csv"], "choose one (episode=0, --episodes 0)"),
        (["inspect", "arm", "--episodes", "0:2"], "this command takes one log; name one episode"),
        (["inspect", "arm", "--episodes", "x"], "'x' is no episode; give numbers, or START:END"),
        (["inspect", "arm", "--episodes", "5:5"], "has no episode, or too many"),
        (["inspect", "arm", "--episodes", "0:99999999999"], "has no episode, or too many"),
        (["inspect", "arm", "--episodes", "7"], "there is no episode 7; found 3 episodes, 0 to 2"),
    ],
)
def test_wrong_episodes_are_refused(arm, command, says):
    run("identify", "arm", *AXIS, "--episodes", "0", "-o", "arm.json")
    done = run(*command)
    assert done.exit_code in (1, 2)
    assert says in " ".join(done.stderr.split())
