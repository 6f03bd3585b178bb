"""Descriptions with inertias that no body can have, and with formats and numbers that MuJoCo does not read."""

import numpy as np
import pytest

import diransac as dr
from command_line import run
from diransac.errors import ModelError
from diransac.model.robots.calibration import calibrated
from test_robots import compiled, inverse, motions, required, without_friction

mujoco = pytest.importorskip("mujoco", reason="INERTIAS OF ROBOTS NOT CHECKED: mujoco is missing")

LINK = '<link name="{}"><inertial><origin xyz="{}"/><mass value="{}"/>{}</inertial></link>'
JOINT = (
    '<joint name="{0}" type="{1}"><parent link="{2}"/><child link="{3}"/><origin xyz="0 0 -0.3"/><axis xyz="0 1 0"/>'
    '<limit lower="-2" upper="2" effort="50" velocity="{4}"/></joint>'
)
GOOD = (0.012, 0.012, 0.001, 0.0, 0.0, 0.0)
IMPOSSIBLE = {
    "zero": (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    "not positive definite": (0.02, 0.03, 0.04, 0.06, 0.01, 0.008),
    "A + B < C": (0.01, 0.01, 0.05, 0.002, 0.0, 0.001),
    "negative": (-0.01, -0.02, -0.01, 0.0, 0.0, 0.0),
}
EVERY_INERTIA = pytest.mark.parametrize("inertia", IMPOSSIBLE.values(), ids=IMPOSSIBLE)


@pytest.fixture
def described(tmp_path):
    """Function that writes a description, and returns its path."""

    def write(text, name="robot.urdf"):
        (tmp_path / name).write_text(text)
        return tmp_path / name

    return write


def link(name, inertia=GOOD, mass=1.2):
    keys = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    values = " ".join(f'{key}="{float(x)!r}"' for key, x in zip(keys, inertia, strict=True))
    return LINK.format(name, "0.01 0.02 -0.15", mass, f"<inertia {values}/>")


def chain(*links, kinds=("revolute", "revolute"), velocity=5):
    """URDF of a base and the links after it, each on the one before."""
    names = ["base", "first", "second"]
    joints = (
        JOINT.format(f"j{k}", kind, names[k], names[k + 1], velocity)
        for k, (kind, _) in enumerate(zip(kinds, links, strict=False))
    )
    return f'<robot name="arm"><link name="base"/>{"".join(links)}{"".join(joints)}</robot>'


def forces(path, **arguments):
    """Residuals of a model with nominal parameters and without friction, in five motions."""
    model = dr.models.robot(path, **arguments)
    p = without_friction(model)
    return np.array([required(model, *motion, p) for motion in motions(len(model.coordinates))])


def tensor(inertia):
    xx, yy, zz, xy, xz, yz = inertia
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def nearest(inertia):
    """Inertia whose second moments are the semidefinite ones nearest to those of another, by Higham 1988."""
    I = tensor(inertia)
    S = 0.5 * np.trace(I) * np.eye(3) - I
    _, s, V = np.linalg.svd(S)
    P = 0.5 * (S + V.T @ np.diag(s) @ V)  # with the polar factor of S
    N = np.trace(P) * np.eye(3) - P
    return tuple(N[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]])


# ---------------------------------------------------------------------- what becomes of them


@EVERY_INERTIA
def test_the_nearest_possible_inertia_of_a_moving_body_is_taken_and_said(described, inertia):
    path = described(chain(link("first"), link("second", inertia)))
    compilable = np.array(nearest(inertia)) + 1e-9 * np.array([1, 1, 1, 0, 0, 0])
    reference, data = compiled(described(chain(link("first"), link("second", compilable)), "nearest.urdf"))
    model = dr.models.robot(path)
    assert "replaced by the nearest possible ones: second (" in model.notes[0]
    for found, motion in zip(forces(path), motions(2), strict=True):
        assert found == pytest.approx(inverse(reference, data, *motion), abs=2e-8)


@EVERY_INERTIA
def test_a_calibrated_file_has_the_nearest_possible_inertias_and_mujoco_compiles_it(described, inertia):
    path = described(chain(link("first"), link("second", inertia)))
    model = dr.models.robot(path)
    values = np.array([1.5 * x.value for x in model.parameters.values()])
    text, _ = calibrated(path, model.parameters, values, 1e-4 * np.eye(len(values)))
    reference, data = compiled(described(text, "calibrated.urdf"))
    for expected, motion in zip(forces(path), motions(2), strict=True):
        assert inverse(reference, data, *motion) == pytest.approx(expected, abs=1e-9)


@EVERY_INERTIA
def test_inertias_of_bodies_that_do_not_move_have_no_effect(described, inertia):
    welded = LINK.format(
        "tray", "0 0 0", 1e-6, link("x", inertia)[link("x").index("<inertia ") : -len("</inertial></link>")]
    )
    weld = '<joint name="w" type="fixed"><parent link="base"/><child link="tray"/></joint>'
    good = chain(link("first"), link("second"))
    path, other = described(good.replace("</robot>", f"{welded}{weld}</robot>")), described(good, "good.urdf")
    assert forces(path, inertia="strict") == pytest.approx(forces(other), abs=1e-12)
    (note,) = dr.models.robot(path).notes
    assert "have no effect, since these bodies do not move: tray (" in note


@EVERY_INERTIA
def test_inertias_of_locked_bodies_have_no_effect(described, inertia):
    path = described(chain(link("first", inertia), link("second")))
    other = described(chain(link("first"), link("second")), "good.urdf")
    swapped = [x.read_text().replace('name="j0" type="revolute"', 'name="j0" type="fixed"') for x in (path, other)]
    files = [described(text, f"{k}.urdf") for k, text in enumerate(swapped)]
    assert forces(files[0], inertia="strict") == pytest.approx(forces(files[1]), abs=1e-12)
    assert forces(path, inertia="strict", joints=["j1"]) == pytest.approx(forces(other, joints=["j1"]), abs=1e-12)


@EVERY_INERTIA
def test_an_unknown_inertia_is_what_is_identified(described, inertia):
    path = described(chain(link("first"), link("second", inertia)))
    other = described(chain(link("first"), link("second")), "good.urdf")
    chosen = {"bodies": ["second"], "unknown": ("damping",), "inertia": "strict"}
    model, theirs = dr.models.robot(path, **chosen), dr.models.robot(other, **chosen)
    assert "unknown here, with nominal values of balls: second (" in model.notes[0]
    p = without_friction(theirs)
    for motion in motions(2):
        assert required(model, *motion, p) == pytest.approx(required(theirs, *motion, p), abs=1e-12)
    covariance = np.diag((1e-6 * np.abs(p) + 1e-9) ** 2)
    text, _ = calibrated(path, model.parameters, p, covariance)
    assert forces(described(text, "found.urdf")) == pytest.approx(forces(other), abs=1e-4)


@EVERY_INERTIA
def test_strict_models_refuse_impossible_inertias_by_name(described, inertia):
    path = described(chain(link("first"), link("second", inertia)))
    with pytest.raises(ModelError, match=r"impossible or absent in the file: second \(.*name the bodies in bodies"):
        dr.models.robot(path, inertia="strict")


def test_an_unknown_treatment_is_refused(described):
    with pytest.raises(ModelError, match='inertia is \'mean\'; give "nearest" or "strict"'):
        dr.models.robot(described(chain(link("first"))), inertia="mean")


@pytest.mark.parametrize("compiler", ["", '<compiler balanceinertia="true"/>', '<compiler boundinertia="0.03"/>'])
def test_inertias_that_mujoco_compiles_are_its_own(described, compiler):
    inertia = "0.01 0.01 0.05" if compiler else "0.01 0.03 0.04"
    text = f"""<mujoco>{compiler}<worldbody><body name="a"><joint axis="1 2 3"/>
      <inertial pos="0 .1 -.2" mass="1" quat="1 .2 .3 .4" diaginertia="{inertia}"/></body></worldbody></mujoco>"""
    path = described(text, "a.xml")
    reference, data = compiled(path)
    assert dr.models.robot(path, inertia="strict").notes == ()
    expected = [inverse(reference, data, *motion) for motion in motions(1)]
    assert forces(path) == pytest.approx(np.array(expected), abs=1e-9)


def test_a_thin_rod_is_possible_whatever_its_rounding(described):
    rod = """<mujoco><worldbody><body name="a"><joint axis="1 0 0"/>
      <inertial pos="0 0 -.2" mass="1" diaginertia="0.7 0.1 0.8"/></body></worldbody></mujoco>"""
    path = described(rod, "rod.xml")
    with pytest.raises(ValueError, match=r"A \+ B >= C"):  # 0.7 + 0.1 < 0.8 in floating point
        compiled(path)
    reference, data = compiled(described(rod.replace("0.8", "0.79"), "thicker.xml"))  # the same about this axis
    expected = [inverse(reference, data, *motion) for motion in motions(1)]
    assert forces(path, inertia="strict") == pytest.approx(np.array(expected), abs=1e-9)


# ---------------------------------------------------------------------- without a mass


def test_a_link_without_a_mass_is_a_frame(described):
    path = described(chain('<link name="first"/>', link("second")))
    joints = '<joint name="j0" pos="0 0 .3" axis="0 1 0"/><joint name="j1" axis="0 1 0"/>'
    inertial = '<inertial pos="0.01 0.02 -0.15" mass="1.2" diaginertia="0.012 0.012 0.001"/>'
    both = f'<mujoco><worldbody><body pos="0 0 -.6">{joints}{inertial}</body></worldbody></mujoco>'
    reference, data = compiled(described(both, "one_body.xml"))
    expected = [inverse(reference, data, *motion) for motion in motions(2)]
    assert forces(path) == pytest.approx(np.array(expected), abs=1e-12)
    assert dr.models.robot(path).notes == ("bodies that move have no mass in the file, and add none: first",)
    with pytest.raises(ModelError, match="impossible or absent in the file: first"):
        dr.models.robot(path, inertia="strict")


def test_a_link_without_a_mass_keeps_its_inertia(described):
    path = described(chain(link("first", mass=0.0), link("second")))
    text = chain(link("first", mass=0.0), link("second")).replace('<mass value="0.0"/>', '<mass value="1e-13"/>')
    reference, data = compiled(described(text, "light.urdf"))
    expected = [inverse(reference, data, *motion) for motion in motions(2)]
    assert forces(path) == pytest.approx(np.array(expected), abs=1e-12)
    alone = described(chain(link("first", mass=0.0)), "wheel.urdf")
    assert forces(alone)[:, 0] == pytest.approx(GOOD[1] * motions(1)[:, 2, 0], abs=1e-12)


@pytest.mark.parametrize(
    "second", ['<link name="second"/>', link("second", [0.0] * 6, 0.0), link("second", GOOD, -1.0)]
)
def test_a_joint_that_moves_no_mass_is_named(described, second):
    path = described(chain(link("first"), second))
    with pytest.raises(ModelError, match='nothing that joint "j1" moves has a mass; give body "second"'):
        dr.models.robot(path)
    assert list(dr.models.robot(path, joints=["j0"]).coordinates) == ["j0"]
    other = dr.models.robot(described(chain(link("first"), link("second")), "good.urdf"), bodies=["second"])
    assert list(dr.models.robot(path, bodies=["second"]).parameters) == list(other.parameters)


def test_an_arm_without_any_mass_is_identified_where_its_bodies_are_unknown(described):
    path = described(chain('<link name="first"/>', '<link name="second"/>'))
    with pytest.raises(ModelError, match='nothing that joint "j0" moves has a mass'):
        dr.models.robot(path)
    other = dr.models.robot(described(chain(link("first"), link("second")), "good.urdf"), bodies="all")
    assert list(dr.models.robot(path, bodies="all").parameters) == list(other.parameters)


def test_the_mass_of_shapes_in_a_urdf_is_said(described):
    box = '<link name="first"><collision><geometry><box size=".1 .2 .3"/></geometry></collision></link>'
    path = described(chain(box))
    reference, data = compiled(path)
    expected = [inverse(reference, data, *motion) for motion in motions(1)]
    assert forces(path) == pytest.approx(np.array(expected), abs=1e-12)
    assert dr.models.robot(path).notes == (
        "the mass of bodies without an inertial is that of their shapes, of 1000 kg/m^3: first",
    )


# ---------------------------------------------------------------------- simulated


@EVERY_INERTIA
def test_a_simulated_machine_has_the_nearest_possible_inertias(described, inertia):
    path = described(chain(link("first"), link("second", inertia)))
    model = dr.models.mujoco(path, unknown=["joint/j0.damping", "joint/j1.damping"])
    assert model.with_fixed({"joint/j0.damping": 0.1}).notes == model.notes
    assert "replaced by the nearest possible ones: second (" in model.notes[0]
    masses, expected = model.compiled, compiled(described(chain(link("first"), link("second")), "good.urdf"))[0]
    assert masses.body_mass[-1] == expected.body_mass[-1]
    assert np.sort(masses.body_inertia[-1]) == pytest.approx(np.linalg.eigvalsh(tensor(nearest(inertia))), abs=4e-6)


def test_a_plate_can_be_simulated_whatever_the_digits_of_the_text(described):
    plate = "0.01234567 0.02345678 0.03580245"
    path = described(
        f"""<mujoco><worldbody><body name="a"><joint name="j" axis="1 2 0"/>
          <inertial pos="0 0 -.2" mass="1" diaginertia="{plate}"/></body></worldbody></mujoco>""",
        "plate.xml",
    )
    model = dr.models.mujoco(path, unknown=["joint/j.damping"])
    assert model.notes == ()
    assert model.compiled.body_inertia[-1] == pytest.approx(compiled(path)[0].body_inertia[-1], rel=1e-4)


def test_a_simulated_joint_that_moves_no_mass_is_named(described):
    path = described(chain(link("first"), '<link name="second"/>'))
    with pytest.raises(ModelError, match='nothing that body "second" carries has a mass'):
        dr.models.mujoco(path, unknown=["joint/j0.damping"])


# ---------------------------------------------------------------------- notes


def test_notes_of_a_model_are_in_inspections_and_results(described, tmp_path):
    path = described(chain(link("first", IMPOSSIBLE["zero"])))
    (note,) = dr.models.robot(path).notes
    t = np.arange(0.0, 2.0, 0.01)
    q = np.sin(2.0 * t + t**2)
    log = dr.Log.from_arrays(t, {"j0": q, "j0_dot": np.gradient(q, t), "j0_torque": 3.0 * np.cos(3.0 * t)})
    log.write(tmp_path / "log.csv")
    done = run("inspect", str(tmp_path / "log.csv"), "--model", str(path))
    assert done.exit_code == 0
    assert done.stdout.count(note) == 1
    words = ["identify", str(tmp_path / "log.csv"), "--differentiate", "--model", str(path), "--method", "ols"]
    done = run(*words, "-o", str(tmp_path / "arm.json"))
    assert done.exit_code == 0, done.stderr
    assert done.stdout.count(note) == 1
    assert note in dr.Result.load(tmp_path / "arm.json").notes
    done = run(*words, "--inertia", "strict")
    assert done.exit_code == 1
    assert "impossible or absent in the file: first (it is zero)" in done.stderr


# ---------------------------------------------------------------------- formats


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("arm.urdf.xacro", '<robot name="a"><xacro:leg/></robot>', "expand them: xacro arm.urdf.xacro > arm.urdf"),
        ("arm.urdf", '<robot name="a"><xacro:leg/></robot>', "expand them: xacro arm.urdf > arm-expanded.urdf"),
        ("arm.xacro", '<robot name="a"><link name="${n}"/></robot>', "expand them: xacro arm.xacro > arm.urdf"),
        ("arm.urdf", '<robot name="a"><origin xyz="$(arg x) 0 0"/></robot>', "has macros of Xacro"),
        ("arm.sdf", '<sdf version="1.7"><model name="a"/></sdf>', "is SDF, which is not read here"),
        ("arm.xml", "<mujocoinclude><body/></mujocoinclude>", "give the file that includes it"),
    ],
)
def test_other_formats_are_refused_with_what_to_do(described, name, text, message):
    path = described(text, name)
    with pytest.raises(ModelError, match=message):
        dr.models.robot(path)
    done = run("design", str(path), "-o", str(path.parent / "design.csv"))
    assert done.exit_code == 1
    assert message in done.stderr


@pytest.mark.parametrize("name", ["arm.mjcf", "ARM.XML", "arm.xacro", "arm.urdf"])
def test_files_are_read_whatever_their_ending(described, name):
    expected = forces(described(chain(link("first")), "good.urdf"))
    assert forces(described(chain(link("first")), name)) == pytest.approx(expected, abs=1e-12)


def test_inertials_of_urdf_may_be_incomplete(described):
    inertial = '<inertial><origin xyz="0.01 0.02 -0.15"/><mass value="1.2"/></inertial>'
    path = described(chain(f'<link name="first">{inertial}</link>', link("second")))
    zero = described(chain(link("first", IMPOSSIBLE["zero"]), link("second")), "zero.urdf")
    assert forces(path) == pytest.approx(forces(zero), abs=1e-12)
    assert "nearest possible ones: first (it is zero)" in dr.models.robot(path).notes[0]
    flywheel = link("first").replace('<mass value="1.2"/>', "")
    assert (
        "no mass in the file, and add none: first"
        in dr.models.robot(described(chain(flywheel, link("second")))).notes[0]
    )


def test_meshes_matter_only_where_they_give_an_inertia_of_what_moves(described):
    mesh = '<collision><geometry><mesh filename="package://arm/meshes/{}.stl"/></geometry></collision>'
    visual = mesh.format("seen").replace("collision>", "visual>")
    shapes = link("first").replace("<inertial>", mesh.format("first") + visual + "<inertial>", 1)
    good = chain(shapes, link("second")).replace(
        '<link name="base"/>', f'<link name="base">{mesh.format("base")}</link>'
    )
    expected = forces(described(chain(link("first"), link("second")), "good.urdf"))
    assert forces(described(good)) == pytest.approx(expected, abs=1e-12)
    bare = f'<link name="second">{mesh.format("second")}</link>'
    with pytest.raises(ModelError, match=r'meshes/second.stl" does not exist.*have that of their meshes \(second\)'):
        dr.models.robot(described(chain(shapes, bare)))


def test_tendons_without_force_may_wrap_shapes(described):
    text = """<mujoco><worldbody><site name="a"/><body name="arm" pos="0 0 1"><joint axis="0 1 0"/>
      <inertial pos="0 0 .1" mass="1" diaginertia="1 1 1"/><geom name="w" size=".1"/><site name="b" pos="0 0 1"/>
      </body></worldbody><tendon><spatial><site site="a"/><geom geom="w"/><site site="b"/><pulley divisor="2"/>
      <site site="a"/><site site="b"/></spatial></tendon></mujoco>"""
    path = described(text, "tendon.xml")
    reference, data = compiled(path)
    expected = [inverse(reference, data, *motion) for motion in motions(1)]
    assert forces(path) == pytest.approx(np.array(expected), abs=1e-12)


def test_a_tendon_of_a_joint_that_is_not_there_is_named(described):
    text = """<mujoco><worldbody><body><joint/><geom size=".1"/></body></worldbody>
      <tendon><fixed><joint joint="elbow" coef="1"/></fixed></tendon></mujoco>"""
    with pytest.raises(ModelError, match="joint 'elbow' not found in tendon"):
        dr.models.robot(described(text, "tendon.xml"))


@pytest.mark.parametrize("kind", ["revolute", "prismatic", "continuous", "planar"])
def test_joints_without_limits_and_elements_of_others_are_read(described, kind):
    text = chain(link("first"), link("second"), kinds=("revolute", kind))
    limit = '<limit lower="-2" upper="2" effort="50" velocity="5"/>'
    others = '<transmission name="t"><joint name="j0"/></transmission><gazebo reference="first"><mu1>1</mu1></gazebo>'
    path = described(text.replace(limit, "").replace("</robot>", f"{others}</robot>"))
    reference, data = compiled(path)
    expected = [inverse(reference, data, *motion) for motion in motions(reference.nv)]
    assert forces(path) == pytest.approx(np.array(expected), abs=1e-12)
    assert dr.models.robot_limits(path) == {}


# ---------------------------------------------------------------------- limits of velocities


def test_velocity_limits_of_a_urdf_are_limits_of_the_robot(described):
    text = chain(link("first"), link("second"), velocity=0.5).replace('velocity="0.5"', 'velocity="0"', 1)
    found = dr.models.robot_limits(described(text), joints={"shoulder": "j0", "elbow": "j1"})
    assert found == {
        "shoulder": (-2.0, 2.0), "shoulder_torque": (-50.0, 50.0),
        "elbow": (-2.0, 2.0), "elbow_torque": (-50.0, 50.0), "elbow_dot": (-0.5, 0.5),
    }  # fmt: skip


def test_a_designed_motion_is_within_the_velocity_limits_of_the_file(described, tmp_path):
    path, output = described(chain(link("first"), velocity=0.5)), tmp_path / "design.csv"
    done = run("design", str(path), "--duration", "4", "--frequency", "1", "--time-limit", "30", "-o", str(output))
    assert done.exit_code == 0, done.stderr
    speed = np.abs(dr.read_log(output)["j0_dot"]).max()
    assert 0.4 < speed <= 0.5 + 1e-6
