"""Plants of studies: those that come with the package, and those of users' files."""

import json
import os
import re
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import diransac as dr
from diransac.study import load
from diransac.study.plants import PlantChoice
from studies import tiny

OWN = """
from pathlib import Path
import diransac as dr
import numpy as np
from sledge_mass import MASS

def sledge(pull: float = 0.0, parameters={"mass": MASS}, teeth: int = 3, label: str = "a", stiff: bool = False):
    if label == "broken":
        raise RuntimeError("no such sledge,\\n\\tnowhere")
    if label == "model":
        return model
    hook = dr.Disturbance(model, "hook", forces=lambda q, v, u, p, d: {"s": d.pull}, constants={"pull": pull * teeth})
    return dr.Plant(model, parameters, (hook,))

def demanding(pull):
    pass

def open_to_all(gust=0, winds=(1, 2.5), *others, **more):
    return sledge(gust + sum(winds))

def of_an_array(pull=np.zeros(2)):
    pass

def of_a_numpy_number(teeth=np.int64(3)):
    pass

def of_a_path(route=Path("a")):
    pass

def endless(pull=float("inf")):
    pass

table = dict

model = dr.Model("sledge", {"s": "m"}, {"force": "N"}, {"mass": dr.Parameter("kg", positive=True)},
                 lambda q, v, a, u, p: [p.mass * a.s - u.force])
"""

SINES = {"trajectory": "multisine", "duration": 5.0}
JUDGED = {"evaluation": {"trajectories": [], "parameters": True}}


@pytest.fixture
def own(tmp_path, monkeypatch):
    (tmp_path / "sledges.py").write_text(OWN)
    (tmp_path / "sledge_mass.py").write_text("MASS = 3.5\n")
    monkeypatch.chdir(tmp_path)
    return tmp_path / "sledges.py"


def acceleration(plant: dr.Plant, state, inputs, phase: float) -> np.ndarray:
    """What the plant really does, its drive at a phase."""
    hidden = [phase] * (len(plant.simulated.state) - len(plant.model.state))
    return np.array(plant.simulated.dynamics([*state, *hidden], inputs, plant.constants)[1]).ravel()


def alone(plant: dr.Plant, state, inputs) -> np.ndarray:
    """What its model says."""
    return np.array(plant.model.dynamics(state, inputs, list(plant.parameters.values()))[1]).ravel()


# ---------------------------------------------------------------------- those of the package


def test_cogging_pulls_an_axis_to_and_fro_every_24_mm():
    plant = PlantChoice.from_dict({"kind": "servo-axis", "cogging": 9.5, "parameters": {"mass": 50.0}}).plant
    for position in np.linspace(0.0, 0.05, 11):
        state, phase = [position, 0.3], 0.4
        pull = 50.0 * (acceleration(plant, state, [7.0], phase) - alone(plant, state, [7.0]))
        assert pull == pytest.approx(9.5 * np.cos(2 * np.pi * position / 0.024 + phase), abs=1e-9)
    assert plant.parameters == {"mass": 50.0, "viscous_friction": 200.0, "dry_friction": 20.0, "offset": -12.0}


def test_ripple_of_a_pendulum_is_a_torque():
    plant = PlantChoice.from_dict({"kind": "pendulum", "ripple": 0.1}).plant
    state, phase = [0.5, 1.0], 1.1
    torque = 0.5 * 0.6**2 * (acceleration(plant, state, [0.2], phase) - alone(plant, state, [0.2]))
    assert torque == pytest.approx(0.1 * np.cos(126 * 0.5 + phase))
    by_hand = -9.81 / 0.6 * np.sin(0.5) + (0.2 - 0.05 * 1.0) / (0.5 * 0.6**2)
    assert alone(plant, state, [0.2]) == pytest.approx(by_hand)


def test_ripple_of_a_double_pendulum_is_a_torque_at_each_joint():
    plant = PlantChoice.from_dict({"kind": "double-pendulum", "ripple": 0.02}).plant
    state, phase, torques = [0.3, -0.8, 0.5, 0.2], 0.7, np.array([0.1, 0.05])
    ripples = 0.02 * np.cos(126 * np.array(state[:2]) + phase)
    assert acceleration(plant, state, torques, phase) == pytest.approx(alone(plant, state, torques + ripples))


def test_gusts_push_a_rotorcraft_by_five_sines_that_are_drawn_by_themselves():
    given = {"kind": "rotorcraft-in-gusts", "gusts": 0.3, "moment_gusts": 0.004}
    plant = PlantChoice.from_dict(given).plant
    state, inputs, size = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6], [2.4, 0.1], np.array([0.3, 0.3, 0.004])
    pushed = acceleration(plant, state, inputs, 0.7) - alone(plant, state, inputs)
    assert pushed * [0.249, 0.249, 0.004] == pytest.approx(size * np.sqrt(2 / 5) * 5 * np.sin(0.7))
    rates = np.array(plant.simulated.dynamics([*state, *[0.0] * 15], inputs, plant.constants)[0]).ravel()
    assert rates[6:].reshape(3, 5) / (2 * np.pi) == pytest.approx(np.tile([0.11, 0.23, 0.54, 1.2, 2.6], (3, 1)))


def test_drag_of_an_underwater_vehicle_is_that_of_its_motion_through_the_water():
    plant = PlantChoice.from_dict({"kind": "underwater-vehicle", "waves": 1.3, "current": 0.05}).plant
    current, waves = 0.05 * np.sqrt(2) * np.sin(1.1), 1.3 * np.sqrt(2 / 3) * 3 * np.sin(1.1)
    through = 0.3 - current
    by_hand = (9.0 + waves - 11.0 * through - 38.0 * abs(through) * through - 1.6) / 42.0
    assert acceleration(plant, [0.0, 0.3], [9.0], 1.1) == pytest.approx(by_hand)


@pytest.mark.parametrize(
    "kind", ["servo-axis", "double-pendulum", "pendulum", "rotorcraft-in-gusts", "underwater-vehicle"]
)
def test_without_anything_given_a_plant_is_what_its_model_says_and_draws_its_phase(kind):
    choice = PlantChoice.from_dict({"kind": kind})
    plant, state = choice.plant, np.linspace(0.1, 0.4, 2 * choice.plant.model.n_q)
    inputs = np.ones(plant.model.n_u)
    np.testing.assert_allclose(acceleration(plant, state, inputs, 0.3), alone(plant, state, inputs), atol=1e-12)
    assert choice.is_drawn
    assert all(start == (0.0, 2 * np.pi) for start in plant.disturbances[0].start.values())


# ---------------------------------------------------------------------- a user's own

MEETING = """
import threading

both, met = threading.Barrier(2), []

def meet():
    try:
        both.wait(0.1)
    except threading.BrokenBarrierError:
        both.reset()
    else:
        met.append("two threads ran users' code at once")
"""
MET_BY = """
import meeting
from sledges import model
import diransac as dr

meeting.meet()

def plant(label: str = "a"):
    meeting.meet()
    return dr.Plant(model, {"mass": 1.0})
"""


def test_a_users_plant_takes_its_keys_and_its_file_may_import_its_neighbours(own):
    study = load(tiny(plant={"kind": "sledges.py:sledge", "pull": 2, "teeth": 4, "stiff": True}, data=SINES, **JUDGED))
    plant = study.plant.plant
    assert plant.parameters == {"mass": 3.5}
    assert plant.disturbances[0].constants == {"pull": 8.0}
    assert study.plant.arguments == {
        "pull": 2.0, "parameters": {"mass": 3.5}, "teeth": 4, "label": "a", "stiff": True,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("given", "kept", "pull"),
    [
        ({}, {"gust": 0, "winds": [1, 2.5]}, 3.5),
        ({"gust": 2.5}, {"gust": 2.5, "winds": [1, 2.5]}, 6.0),
        ({"gust": 1, "winds": [4, 5, 6.5]}, {"gust": 1, "winds": [4, 5, 6.5]}, 16.5),
    ],
)
def test_numbers_of_a_users_plant_may_have_a_fraction_where_nothing_says_that_they_count(own, given, kept, pull):
    choice = PlantChoice.from_dict({"kind": "sledges.py:open_to_all", **given})
    assert choice.arguments == kept
    assert choice.plant.disturbances[0].constants == {"pull": 3 * pull}
    assert PlantChoice.from_dict(choice.to_dict()) == choice


def test_an_axis_may_lead_into_a_users_plant(own):
    axis = {"path": "plant.pull", "levels": [0, 5]}
    study = load(tiny(plant={"kind": "sledges.py:sledge"}, data=SINES, axis=axis, **JUDGED))
    pulls = [study.at(level).plant.plant.disturbances[0].constants["pull"] for level in ("0", "5")]
    assert pulls == [0.0, 15.0]


def test_threads_run_users_code_one_at_a_time_and_leave_the_process_as_it_was(own):
    (own.parent / "meeting.py").write_text(MEETING)
    (own.parent / "met.py").write_text(MET_BY)

    def shared() -> tuple:
        return os.fstat(1).st_ino, os.fstat(2).st_ino, list(sys.path), sys.dont_write_bytecode

    before = shared()
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(PlantChoice.from_dict, [{"kind": "met.py", "label": label} for label in "ab"]))
    assert sys.modules.pop("meeting").met == []
    assert shared() == before


def test_a_users_file_that_has_changed_is_another_study(own):
    before = load(tiny(plant={"kind": "sledges.py:sledge"}, data=SINES, **JUDGED))
    begun = json.loads(json.dumps(before.to_dict()))
    assert load(begun) == before
    own.write_text(OWN + "\n# changed\n")
    after = load(tiny(plant={"kind": "sledges.py:sledge"}, data=SINES, **JUDGED))
    assert after.configuration["study"] != before.configuration["study"]
    begun["plant"]["file_digest"] = "0123456789abcdef"  # as another machine may have it
    with pytest.raises(dr.SettingsError, match="is not the file that the study was begun with: its digest is"):
        load(begun)


@pytest.mark.parametrize(
    ("plant", "message"),
    [
        ({"kind": "none.py:sledge"}, '"none.py" cannot be read: No such file or directory; it must be there wherever'),
        ({"kind": "sledges.py"}, 'has no function "plant" that returns a diransac.Plant; functions found: sledge, dem'),
        ({"kind": "sledges.py:model"}, 'has no function "model"'),
        ({"kind": "sledges.py:demanding"}, '"demanding" needs pull; give every argument a default'),
        ({"kind": "sledges.py:table"}, 'sledges.py": "table" has no signature that can be read; wrap it in'),
        ({"kind": "sledges.py:of_an_array"}, r'"of_an_array" has pull = array.* \(ndarray\); give a default that TOML'),
        ({"kind": "sledges.py:of_a_numpy_number"}, r'"of_a_numpy_number" has teeth = .*3.* \(int64\); give a default'),
        ({"kind": "sledges.py:of_a_path"}, r'"of_a_path" has route = .*Path\(.*; give a default that TOML'),
        ({"kind": "sledges.py:endless"}, r'"endless" has pull = inf \(float\); give a default that TOML'),
        ({"kind": "sledges.py:open_to_all", "winds": ["hard"]}, "plant.winds is .*hard.*; give a list of numbers"),
        ({"kind": "sledges.py:open_to_all", "gust": 10**400}, "plant.gust is 1000.*; give a number"),
        ({"kind": "sled\0ges.py"}, r"plant.kind is 'sled\\x00ges.py'; there are .* or give FILE.py:NAME"),
        ({"kind": "sledges.py:sledge", "wind": 1}, 'no key "plant.wind"; in plant there are kind, pull, .*stiff$'),
        ({"kind": "sledges.py:sledge", "pull": "hard"}, "plant.pull is 'hard'; give a number"),
        ({"kind": "sledges.py:sledge", "teeth": 2.5}, "plant.teeth is 2.5; give a whole number from 0"),
        ({"kind": "sledges.py:sledge", "stiff": 1}, "plant.stiff is 1; give true or false"),
        (
            {"kind": "sledges.py:sledge", "label": "broken"},
            r'sledges.py", line 9: RuntimeError: no such sledge, nowhere$',
        ),
        ({"kind": "sledges.py:sledge", "label": "model"}, '"sledge" returns a Model, not a diransac.Plant'),
        ({"kind": "servo-axis", "cogging": [1.0, 2.0]}, "plant: .*cogging is .*give a finite number"),
    ],
)
def test_a_plant_that_makes_no_sense_is_refused_with_its_line(own, plant, message):
    with pytest.raises(dr.SettingsError, match=message):
        PlantChoice.from_dict(plant)


def test_a_file_that_cannot_be_run_is_refused_with_its_line(own):
    own.write_text("import diransac\n\n1 / 0\n")
    with pytest.raises(dr.SettingsError, match=re.escape('plant file "sledges.py", line 3: ZeroDivisionError')):
        PlantChoice.from_dict({"kind": "sledges.py:sledge"})
