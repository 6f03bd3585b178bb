"""Studies as people write them: what is understood, and what is refused by name."""

import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

import diransac as dr
from diransac.study import FlightChoice, builtin_names, load, template
from diransac.study.data import derived_seed
from diransac.study.plants import PlantChoice
from studies import TINY, tiny

STUDY = load(TINY)


# What is understood ---------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", builtin_names())
def test_a_built_in_study_survives_being_written_as_json(name: str):
    study = load(name)
    assert load(json.loads(json.dumps(study.to_dict()))) == study
    assert study.name == name


def test_the_figures_of_the_paper_vary_what_they_say():
    levels = {name: list(map(float, load(name).axis.levels)) for name in ("fig2", "fig3", "fig4", "fig5")}
    assert levels == {
        "fig2": [0, 10, 20, 30, 40, 50, 60, 70, 80, 90, 100],
        "fig3": pytest.approx([1.0e-6, 1.2e-6, 1.4e-6, 1.6e-6, 1.8e-6], rel=1e-12),
        "fig4": pytest.approx([6e-5, 8e-5, 1e-4, 1.2e-4, 1.4e-4], rel=1e-12),
        "fig5": [80],
    }
    flown = [load(f"fig{k}").evaluation.trajectories for k in (2, 3, 4, 5)]
    assert flown == [
        ("square",),
        ("sine",),
        ("sine",),
        ("square", "sine"),
    ]
    assert load("fig2").noise.outlier_probability == 0.1
    assert load("fig3").at("1.8e-06").plant.arguments["aerodynamic_imbalance"] == 1.8e-6
    assert load("fig4").at("0.00014").plant.arguments["mass_imbalance"] == 1.4e-4
    assert all(load(name).data == FlightChoice(trajectory="star") and load(name).trials == 50 for name in levels)
    assert load("fig5").evaluation.keep_paths


@pytest.mark.parametrize("name", ["fig2", "fig3", "fig4", "fig5", "gaussian"])
def test_every_figure_shows_the_true_parameters_and_the_methods_of_the_paper_with_its_settings(name: str):
    methods = load(name).methods
    assert {"true", "ols", "diransac", "i-diransac", "lo-diransac"} <= {one.method for one in methods.values()}
    assert methods["i-diransac"].settings == dr.Settings.table_iv()
    assert methods["diransac-without-refit"].settings.refit == "none"


def test_the_gaussian_sweep_moves_both_deviations_from_end_to_end_of_table_iii():
    ends = [load("gaussian").at(level).noise for level in ("0", "1")]
    assert [(noise.acceleration_std, noise.rate_std) for noise in ends] == [(0.04, 0.003), (2.5, 1.0)]


GAUNTLET = [name for name in builtin_names() if name.startswith("gauntlet")]


@pytest.mark.parametrize("name", GAUNTLET)
def test_every_trial_of_the_gauntlet_flies_another_flight_and_is_judged_by_its_parameters(name: str):
    study = load(name)
    assert study.data.is_drawn
    assert study.data.substeps == 20
    assert study.plant.is_drawn
    assert study.evaluate_parameters
    assert study.evaluation.trajectories == (("square",) if name == "gauntlet" else ())
    assert {"diransac", "lo-diransac"} <= {method.method for method in study.methods.values()}


@pytest.mark.slow
@pytest.mark.parametrize("name", GAUNTLET)
def test_runs_of_faults_strike_about_a_fifth_of_the_gauntlets_samples(name: str):
    study = load(name)
    log = dr.fly(plant := study.plant.plant, flown := study.data.planned(plant, 5), dr.tvlqr(plant, flown))
    assert {"bursts", "frozen", "missing"} <= set(study.axis.levels)
    for level in ("bursts", "frozen", "missing"):
        shares = [np.mean([*dr.corrupt(log, study.at(level).noise, seed).fault_mask.values()]) for seed in range(20)]
        assert np.mean(shares) == pytest.approx(0.2, abs=0.02)


def test_the_gauntlet_goes_to_the_ends_of_the_papers_ranges():
    study = load("gauntlet")
    most = study.at("everything at its maximum")
    assert (most.noise.acceleration_std, most.noise.rate_std, most.noise.outlier_probability) == (2.5, 1.0, 0.5)
    assert most.plant.arguments["aerodynamic_imbalance"] == float([*load("fig3").axis.levels][-1])
    assert most.plant.arguments["mass_imbalance"] == float([*load("fig4").axis.levels][-1])


def test_the_template_is_a_study_and_comments_every_table():
    study = load(tomllib.loads(template()))
    assert study.methods["all-iterations"].settings.stop_inlier_fraction is None
    lines = template().splitlines()
    assert all("#" in line for line in lines if re.match(r"\[(plant|data|noise|evaluation|axis)\]", line))


def test_levels_are_the_same_however_they_are_written():
    study = load(tiny(axis__levels=[0, 0.0000010, 80.0, -0.0000010 + 0.0000010 + 3]))
    assert list(study.axis.levels) == ["0", "1e-06", "80", "3"]
    assert study.subset(levels=["80.00", 3]).axis.levels == study.subset(levels=[80, "3"]).axis.levels


def test_a_level_that_has_a_path_may_be_new_and_a_combination_may_not():
    assert STUDY.subset(levels=[55]).at("55").noise.outlier_magnitude == 55.0
    with pytest.raises(dr.SettingsError, match=r'no level "0.3".*there are 0, 0.25, 0.5, 0.75, 1'):
        load("gaussian").subset(levels=["0.3"])


WORDS = {
    "calm": {},
    "some": {"noise.outlier_probability": 0.2, "noise": {"delay": 0.02}},
    "much": {"noise": {"outlier_probability": 0.5}},
}


def test_levels_that_are_words_may_each_change_something_else():
    study = load(tiny(axis={"name": "scenario", "levels": WORDS}))
    assert list(study.axis.levels) == ["calm", "some", "much"]
    assert [study.at(level).noise.outlier_probability for level in WORDS] == [0.1, 0.2, 0.5]
    assert [study.at(level).noise.delay for level in WORDS] == [0.0, 0.02, 0.0]
    for some in (study, study.subset(levels=["calm"])):
        assert load(json.loads(json.dumps(some.to_dict()))) == some


def test_levels_that_are_words_may_look_like_numbers():
    study = load(tiny(axis={"levels": {"1e3": {"noise.delay": 0.01}, "1000": {"noise.delay": 0.02}, "007": {}}}))
    assert [study.at(text).noise.delay for text in ("1e3", "1000", "007")] == [0.01, 0.02, 0.0]
    assert list(study.subset(levels=["007", "1e3"]).axis.levels) == ["007", "1e3"]


def test_a_level_may_fly_another_trajectory_which_takes_over_what_was_given_but_no_defaults():
    study = load(
        tiny(
            data={"trajectory": "random-waypoints", "substeps": 7}, axis={"path": "data.trajectory", "levels": ["star"]}
        )
    )
    assert study.at("star").data == FlightChoice(trajectory="star", substeps=7)
    given = {"trajectory": "random-waypoints", "duration": 25.0, "seed": "random"}
    study = load(tiny(data=given, axis={"path": "data.trajectory", "levels": ["random-waypoints"]}))
    assert study.at("random-waypoints").data == study.data
    with pytest.raises(dr.SettingsError, match=r'at level star, there is no key "data.seed"; in data there are'):
        load(tiny(data=given, axis={"path": "data.trajectory", "levels": ["star"]}))


def test_a_level_may_fly_another_plant_which_takes_over_what_was_given_but_no_defaults():
    axis = {"path": "plant.kind", "levels": ["servo-axis", "pendulum"]}
    data = {"trajectory": "multisine", "seed": "random", "duration": 5.0}
    judged = {"trajectories": [], "parameters": True}
    study = load(tiny(plant={"kind": "servo-axis"}, data=data, evaluation=judged, axis=axis))
    assert study.at("pendulum").plant == PlantChoice.from_dict({"kind": "pendulum"})
    assert study.at("pendulum").data == study.data
    rotorcraft = {"kind": "extended-rotorcraft", "parameters": {"mass": 0.3}}
    study = load(tiny(plant=rotorcraft, axis={"path": "plant.kind", "levels": ["planar-rotorcraft"]}))
    assert study.at("planar-rotorcraft").plant.plant.parameters == {**dr.models.TABLE_I, "mass": 0.3}


def test_a_preset_cannot_vary_as_it_would_change_nothing():
    with pytest.raises(dr.SettingsError, match=r'"methods.ols.preset" cannot vary.*a preset each'):
        load(tiny(axis={"path": "methods.ols.preset", "levels": ["default", "table-iv"]}))


def test_a_level_that_changes_nothing_is_noted_as_such():
    """A store would take what it never noted for new, and go on with another study."""
    parts = [load(tiny(axis={"levels": {**WORDS, "calm": some}})).configuration for some in ({}, {"noise.delay": 0.1})]
    assert parts[0]["levels.calm"]
    assert parts[0]["levels.calm"] != parts[1]["levels.calm"]


def test_an_axis_may_lead_into_a_method():
    study = load(tiny(axis={"path": "methods.quick.settings.max_iterations", "levels": [5, 50]}))
    assert [study.at(level).methods["quick"].settings.max_iterations for level in ("5", "50")] == [5, 50]
    assert study.subset(methods=["ols"]).at("5").methods.keys() == {"ols"}


def test_settings_are_laid_over_their_preset():
    quick = STUDY.methods["quick"].settings
    assert (quick.max_iterations, quick.inlier_thresholds) == (20, dr.Settings.table_iv().inlier_thresholds)


def test_parameters_that_are_not_named_are_those_of_table_i():
    plant = load(tiny(plant__parameters__mass=0.3)).plant.plant
    assert plant.parameters == {**dr.models.TABLE_I, "mass": 0.3}


def test_a_rotor_phase_may_be_drawn():
    drawn = load(tiny(plant={"kind": "extended-rotorcraft", "rotor_phase": "random"})).plant
    assert drawn.is_drawn
    assert not load("fig4").plant.is_drawn
    assert drawn.plant.disturbances[0].start["phase_1"] == pytest.approx((0.0, 2 * 3.141592653589793))


def test_a_data_flight_has_all_of_its_arguments_and_its_seed_may_be_drawn():
    study = load(tiny(data={"trajectory": "random-waypoints", "seed": "random", "speed": 2, "substeps": 20}))
    assert study.data.is_drawn
    assert study.data.substeps == 20
    assert study.data.arguments == {"seed": "random", "speed": 2.0, "reach": 2.0, "duration": 25.0}
    assert load(json.loads(json.dumps(study.to_dict()))) == study
    assert not load(tiny(data={"trajectory": "random-waypoints", "seed": 3})).data.is_drawn


def test_a_drawn_flight_is_that_of_its_seed_and_any_other_that_of_its_own():
    sines = {"trajectory": "multisine", "duration": 0.5}
    plant = dr.Plant(dr.models.servo_axis(), {"mass": 1.0, "viscous_friction": 1.0, "dry_friction": 1.0, "offset": 1.0})
    drawn, fixed = (FlightChoice.from_dict({**sines, "seed": seed}) for seed in ("random", 3))
    expected = dr.multisine(plant, seed=3, duration=0.5).states
    np.testing.assert_array_equal(drawn.planned(plant, 3, time_limit=5.0).states, expected)
    np.testing.assert_array_equal(fixed.planned(plant, 8).states, expected)
    assert not np.array_equal(drawn.planned(plant, 8).states, expected)


def test_where_parameters_are_judged_no_flight_need_be():
    study = load(tiny(evaluation={"trajectories": [], "parameters": True}))
    assert study.evaluate_parameters
    assert study.evaluation.trajectories == ()
    assert not STUDY.evaluate_parameters
    assert study.configuration != load(tiny(evaluation={"trajectories": ["square"], "parameters": True})).configuration


def test_what_people_call_things_and_how_many_there_are_decide_nothing():
    other = load(tiny(name="b", description="c", trials=9, axis__name="d", methods__ols__settings={"threads": 1}))
    assert other.configuration == STUDY.configuration
    assert load(tiny(seed=8)).configuration != STUDY.configuration


# What is refused ------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"plnt.kind": "x"}, 'no key "plnt"; in a study there are .*plant'),
        ({"trials": 10**20}, "trials is 100000000000000000000; give a whole number from 1 to 10,000,000"),
        ({"trials": 0}, "trials is 0; give a whole number from 1 to 10,000,000"),
        ({"trials": 2.5}, "trials is 2.5; give a whole number"),
        ({"seed": "x"}, "seed is 'x'; give a whole number"),
        ({"plant.kind": "car"}, "plant.kind is 'car'; there are extended-rotorcraft, planar-rotorcraft"),
        ({"plant.wind": 1}, 'no key "plant.wind"; in plant there are kind, parameters'),
        ({"plant.parameters.mas": 0.2}, "plant: .*parameters are mass, inertia, drag; found mas"),
        ({"plant.parameters.mass": "heavy"}, "plant.parameters is .*heavy.*; give a table of numbers"),
        ({"data.trajectory": "loop"}, "data.trajectory is 'loop'; there are square, star, sine"),
        ({"data.reach": 2}, 'no key "data.reach"; in data there are trajectory, substeps, speed, input_weights'),
        ({"data.input_weights": {"lift": 1.0}}, 'data.trajectory has .square.: input_weights names "lift"'),
        ({"missions.circle": {}}, 'no key "missions.circle"; in missions there are square, star, sine'),
        ({"missions.sine.duration": -1}, "missions.sine.duration is -1; give a number above 0"),
        ({"control.Q": -1}, "control.Q is -1; give a number, or a table of numbers by name, from 0"),
        ({"control.Q": {"y": 1}}, 'control.Q weighs "y"; there are x, z, theta'),
        ({"control.R": {"thrust": 1}}, "control.R must be positive definite"),
        ({"methods.ols.estimator": "tls"}, "methods.ols: estimator serves diransac, i-diransac, not ols"),
        ({"noise.outliers": "all"}, "noise.outliers is 'all'; choose 'signals' or 'rows'"),
        ({"data": {"trajectory": "random-waypoints", "speed": "fast"}}, "data.speed is 'fast'; give a number"),
        ({"data": {"trajectory": "random-waypoints", "speed": [1, 2]}}, r"data.speed is \[1, 2\]; give a number"),
        ({"data": {"trajectory": "random-waypoints", "speed": -2}}, "data.speed is -2; give a number above 0"),
        (
            {"data": {"trajectory": "random-waypoints", "duration": 1e12}},
            r"data.duration is 1e\+12; give 3600 s or less",
        ),
        ({"data": {"trajectory": "random-waypoints", "seed": 1.5}}, "data.seed is 1.5; give a whole number from 0"),
        ({"data": {"trajectory": "random-waypoints", "reach": "random"}}, "data.reach is 'random'; give a number"),
        ({"data.substeps": 0}, "data.substeps is 0; give a whole number of at least 1"),
        (
            {"data.trajectory": "multisine"},
            "data.trajectory has 'multisine': model \"planar-rotorcraft\" is not fully actuated",
        ),
        (
            {"plant.kind": "servo-axis", "data.trajectory": "multisine"},
            "evaluation.trajectories has 'square': .* model \"servo-axis\" has no coordinate x",
        ),
        ({"evaluation.parameters": 1}, "evaluation.parameters is 1; give true or false"),
        ({"noise.outlier_probability": 2}, "noise.outlier_probability is 2; give a number from 0 to 1"),
        ({"noise.wind": 2}, 'no key "noise.wind"; in noise there are outlier_probability'),
        ({"methods": {}}, "methods is empty; there are true, ols"),
        ({"methods.mine": {}}, "methods.mine.method is 'mine'; there are true, ols"),
        ({"methods.a": {"method": "ols", "preset": "best"}}, "methods.a.preset is 'best'; there are default, table-iv"),
        (
            {"methods.ols.settings": {"sample_sise": 3}},
            'methods.ols.settings: there is no setting "sample_sise"; did you mean sample_size',
        ),
        ({"methods.ols.settings": {"sample_size": 0}}, "methods.ols.settings: sample_size is 0"),
        ({"methods.a,b": {"method": "ols"}}, 'the label "a,b" has other characters'),
        ({"evaluation.trajectories": ["loop"]}, "evaluation.trajectories has 'loop'; there are square, star, sine"),
        ({"evaluation.trajectories": []}, r"evaluation.trajectories is \[\]; give a list of one or more"),
        ({"evaluation.keep_paths": 1}, "evaluation.keep_paths is 1; give true or false"),
        ({"axis.levels": []}, r"axis.levels is \[\]"),
        ({"axis.levels": [1, 1.0]}, "axis.levels has a level twice; found 1, 1"),
        ({"axis.levels": ["a,b"]}, 'axis.levels has "a,b"; give numbers, or words without commas'),
        ({"axis.levels": [True]}, "axis.levels has true; give numbers"),
        ({"axis.levels": [float("nan")]}, "axis.levels has NaN; give numbers"),
        ({"axis.levels": [0, -5]}, "axis: at level -5, noise.outlier_magnitude is -5"),
        ({"axis.path": "noise.magnitude"}, 'axis: at level 0, there is no key "noise.magnitude"; in noise there are'),
        ({"axis.path": "trials"}, r'axis: at level 0, "trials" cannot vary; there are plant\.\*'),
        ({"axis.path": "data.trajectory.x"}, "leads nowhere: trajectory is 'square', not a table"),
        ({"axis": {"levels": [1, 2]}}, "axis.path is missing; give the dotted path"),
        ({"axis": 3}, "axis is 3; give a table"),
        ({"axis": {"levels": {}}}, "axis.levels is empty; give a table, or a list, of one or more"),
        ({"axis": {"levels": {"a,b": {}}}}, 'axis.levels has "a,b"; give numbers, or words without commas'),
        ({"axis": {"levels": {"a": 3}}}, 'axis.levels."a" is 3; give a table of what it changes, {} for nothing'),
        ({"axis": {"levels": {"a": {"noise.wind": 3}}}}, 'axis: at level a, there is no key "noise.wind"'),
        ({"axis": {"levels": {"a": {}}, "path": "noise.delay"}}, 'no key "axis.path"; in axis there are levels, name'),
    ],
)
def test_a_study_that_makes_no_sense_is_refused_by_its_key(changes: dict, message: str):
    with pytest.raises(dr.SettingsError, match=message):
        load(TINY, changes)


def test_a_level_that_stands_there_twice_is_refused_in_those_words(tmp_path: Path):
    (tmp_path / "a.toml").write_text("[axis.levels]\ncalm = {}\ngusts = {}\ncalm = {}\n")
    with pytest.raises(dr.SettingsError, match=r"a key, or a level, stands there twice \(at line 4, column"):
        load(tmp_path / "a.toml")


def test_a_missing_key_is_named_with_what_was_found():
    message = 'the key "data", which is to hold a table, is missing; in this study there are name, trials'
    with pytest.raises(dr.SettingsError, match=message):
        load({"name": "a", "trials": 1})
    message = 'the key "plant.kind", which is to hold text, is missing; in plant there are kindd'
    with pytest.raises(dr.SettingsError, match=message):
        load({**TINY, "plant": {"kindd": "pendulum"}})


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("fig9", 'study "fig9": there is none of that name; there are fig2, .*or give FILE.toml'),
        ("none.toml", 'study "none.toml": the file cannot be read: No such file'),
    ],
)
def test_a_study_that_is_not_there_is_refused(source: str, message: str):
    with pytest.raises(dr.SettingsError, match=message):
        load(source)


def test_a_file_that_is_no_toml_is_refused(tmp_path):
    (tmp_path / "a.toml").write_text("name = ")
    with pytest.raises(dr.SettingsError, match=r'a.toml" is not TOML: Invalid value'):
        load(tmp_path / "a.toml")


@pytest.mark.parametrize(
    ("narrower", "message"),
    [
        ({"trials": 0}, "trials is 0"),
        ({"methods": ["tls"]}, 'no method "tls"; there are true, ols, quick'),
        ({"methods": []}, "no method named"),
        ({"levels": []}, "no level is named; there are 0, 40"),
        ({"levels": ["some"]}, 'no level "some" of outlier magnitude; there are 0, 40'),
    ],
)
def test_what_a_study_does_not_have_cannot_be_chosen(narrower: dict, message: str):
    with pytest.raises(dr.SettingsError, match=message):
        STUDY.subset(**narrower)


def test_pydantic_is_loaded_with_studies_only():
    code = "import sys, diransac, diransac.cli.commands; print('pydantic' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "False\n"


# Seeds ----------------------------------------------------------------------------------------------------------------
def test_seeds_differ_by_everything_that_they_are_for_and_fit_a_column():
    what = [(seed, level, trial) for seed in range(5) for level in ("0", "1", "10") for trial in range(200)]
    seeds = [derived_seed(*one) for one in what]
    assert len(set(seeds)) == len(what)
    assert min(seeds) >= 0
    assert max(seeds) < 2**63
    assert 0.45 < sum(seed >> 62 for seed in seeds) / len(seeds) < 0.55


def test_a_seed_is_the_same_on_every_machine():
    # blake2b of the JSON text, 8 bytes, shifted by one: what b2sum -l 64 says of it
    assert derived_seed(7, "40", 0) == int("e92befec82203588", 16) >> 1
