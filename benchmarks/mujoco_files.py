"""Nominal MJCF of the machines of `mujoco_cases.py`; some are templates.  Nothing happens when this file is run."""

LEG = """
<body name="{n}_hip" pos="{x} {y} 0">
  <inertial pos="0 {c} 0" mass="0.68" diaginertia="9e-4 6e-4 5e-4"/><joint name="{n}_hip" axis="1 0 0"/>
  <body name="{n}_thigh" pos="0 {w} 0">
    <inertial pos="-0.004 0 -0.033" mass="1.15" diaginertia="6e-3 6e-3 9e-4"/><joint name="{n}_thigh"/>
    <body name="{n}_calf" pos="0 0 -0.213">
      <inertial pos="0.006 0 -0.14" mass="0.24" diaginertia="1.5e-3 1.5e-3 5e-5"/><joint name="{n}_calf"/>
      {foot}
    </body>
  </body>
</body>"""
FOOT = '<geom name="{n}_foot" pos="0 0 -0.213" size="0.022" friction="0.8" priority="1"/>'
QUADRUPED = """
<mujoco>
  <option timestep="0.002"/>
  <default><joint axis="0 1 0" armature="0.006" damping="0.1" frictionloss="0.1"/></default>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1"/>
    <body name="trunk" pos="0 0 0.32">
      <freejoint name="base"/><site name="imu" pos="-0.02 0 0.04"/>
      <inertial pos="0.02 0 -0.005" mass="6.9" diaginertia="0.025 0.098 0.107"/>
      <body name="payload" pos="0 0 0.08"><inertial pos="0 0 0" mass="0.5" diaginertia="2e-3 2e-3 2e-3"/></body>
      {legs}
    </body>
  </worldbody>
  <actuator>{motors}</actuator>
  <sensor><gyro name="imu_gyro" site="imu"/><accelerometer name="imu_acc" site="imu"/></sensor>
  <keyframe><key qpos="0 0 0.308 1 0 0 0 {pose}"/></keyframe>
</mujoco>"""
HANGING = """
<mujoco>
  <option timestep="0.002" integrator="RK4"/>
  <default><joint axis="0 1 0" armature="0.006" damping="0.1"/></default>
  <worldbody>{leg}</worldbody>
  <actuator>
    <motor name="hip" joint="FL_hip"/><motor name="thigh" joint="FL_thigh"/>
    <motor name="calf" joint="FL_calf"/>
  </actuator>
</mujoco>"""
BOX = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1"/>
    <body name="box" pos="0.15 0 0.05">
      <freejoint name="box"/><inertial pos="0 0 0" mass="0.5" diaginertia="2.5e-3 2.5e-3 4e-3"/>
      <geom name="box" type="box" size="0.08 0.1 0.05" friction="0.8" priority="1"/>
    </body>
    <body name="pusher" pos="0 0 0.05">
      <joint name="pusher" type="slide" axis="1 0 0" damping="1"/>
      <inertial pos="0 0 0" mass="0.8" diaginertia="1e-3 1e-3 1e-3"/>
      <geom name="plate" type="box" size="0.01 0.06 0.02"/>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="pusher"/></actuator>
</mujoco>"""
GRIPPER = """
<mujoco>
  <option timestep="0.002"/>
  <default><joint type="slide"/><geom type="box" friction="0.9" priority="1"/></default>
  <worldbody>
    <body name="palm" pos="0 0 0.3">
      <joint name="lift" axis="0 0 1" damping="1"/><inertial pos="0 0 0.05" mass="0.5" diaginertia="1e-3 1e-3 1e-3"/>
      <body name="left" pos="0 0.035 -0.1">
        <joint name="left" axis="0 -1 0" damping="1"/><inertial pos="0 0 0" mass="0.1" diaginertia="1e-4 1e-4 1e-4"/>
        <geom name="pad_left" size="0.02 0.005 0.1"/>
      </body>
      <body name="right" pos="0 -0.035 -0.1">
        <joint name="right" axis="0 1 0" damping="1"/><inertial pos="0 0 0" mass="0.1" diaginertia="1e-4 1e-4 1e-4"/>
        <geom name="pad_right" size="0.02 0.005 0.1"/>
      </body>
    </body>
    <body name="part" pos="0 0 0.26">
      <freejoint name="part"/><inertial pos="0 0 0" mass="0.2" diaginertia="1.5e-4 1.5e-4 1.5e-4"/>
      <geom name="part" size="0.025 0.03 0.025" friction="0.1" priority="0"/>
    </body>
  </worldbody>
  <actuator>
    <motor name="lift_force" joint="lift"/>
    <motor name="left_force" joint="left"/><motor name="right_force" joint="right"/>
  </actuator>
</mujoco>"""
FOUR_BAR = """
<mujoco>
  <option timestep="0.002"/>
  <default>
    <joint axis="0 1 0" damping="0.005"/><geom type="capsule" size="0.008" contype="0" conaffinity="0"/>
  </default>
  <worldbody>
    <body name="crank">
      <joint name="crank" armature="0.002"/><geom fromto="0 0 0 0.04 0 0.0692820" mass="0.15"/>
      <body name="coupler" pos="0.04 0 0.0692820">
        <joint name="coupler"/><inertial pos="0.1 0 0.04" mass="0.3" diaginertia="1.5e-3 1.5e-3 2e-4"/>
        <site name="pin" pos="0.2005513 0 0.0904388"/>
      </body>
    </body>
    <body name="rocker" pos="0.25 0 0">
      <joint name="rocker"/><geom fromto="0 0 0 -0.0094487 0 0.1597208" mass="0.25"/>
    </body>
  </worldbody>
  <equality><connect name="pin" body1="coupler" body2="rocker" anchor="0.2005513 0 0.0904388"/></equality>
  <actuator><motor name="motor" joint="crank"/></actuator>
</mujoco>"""
FINGER = """
<mujoco>
  <option timestep="0.002"/>
  <default><joint axis="0 1 0" stiffness="0.05" damping="0.002" armature="1e-4"/></default>
  <worldbody>
    <site name="s0" pos="0 0 0.012"/>
    <body name="proximal" pos="0.01 0 0">
      <joint name="mcp"/><inertial pos="0.025 0 0" mass="0.03" diaginertia="2e-6 8e-6 8e-6"/>
      <site name="s1" pos="0.015 0 0.01"/><site name="s2" pos="0.04 0 0.01"/>
      <body name="distal" pos="0.05 0 0">
        <joint name="pip"/><inertial pos="0.015 0 0" mass="0.015" diaginertia="5e-7 3e-6 3e-6"/>
        <site name="s3" pos="0.012 0 0.008"/>
      </body>
    </body>
  </worldbody>
  <tendon>
    <spatial name="flexor" frictionloss="0.1">
      <site site="s0"/><site site="s1"/><site site="s2"/><site site="s3"/>
    </spatial>
  </tendon>
  <actuator><motor name="pull" tendon="flexor" gear="-1"/></actuator>
  <sensor><tendonpos name="cable" tendon="flexor"/></sensor>
</mujoco>"""
ARM = """
<mujoco>
  <option timestep="0.002" integrator="RK4"/>
  <default><joint axis="0 1 0" armature="0.005" damping="0.05"/></default>
  <worldbody>
    <body name="upper">
      <joint name="shoulder"/><inertial pos="0 0 -0.15" mass="1.2" diaginertia="0.01 0.01 1e-3"/>
      <body name="lower" pos="0 0 -0.3">
        <joint name="elbow"/><inertial pos="0 0 -0.1" mass="0.6" diaginertia="3e-3 3e-3 4e-4"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="shoulder" joint="shoulder"/><motor name="elbow" joint="elbow"/></actuator>
</mujoco>"""
