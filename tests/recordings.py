"""Recordings of several topics, written as their own tools write them."""

import json
import struct

import numpy as np
import pytest

T = np.arange(200) / 100.0
RNG = np.random.default_rng(3)
X, V, EFFORT = (RNG.normal(size=len(T)) for _ in range(3))


def nanoseconds(k):
    return 1_700_000_000_000_000_000 + 10_000_000 * int(k)


class Ulog:
    """A ULog file that grows, message by message: kind, and content as the format's documentation has it."""

    def __init__(self, start=5_000_000):
        self.start, self.topics = start, {}
        self.data = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", start)
        self.message("B", bytes(40))

    def message(self, kind, content):
        """Add a message of a kind."""
        self.data += struct.pack("<HB", len(content), ord(kind)) + content

    def keyed(self, kind, key, value):
        """Add an information or a parameter."""
        self.message(kind, bytes([len(key)]) + key.encode() + value)

    def format(self, name, fields):
        """Add the format of a topic's records."""
        self.message("F", f"{name}:{fields}".encode())

    def subscribe(self, number, name, instance=0):
        """Announce a topic under a number."""
        self.message("A", struct.pack("<BH", instance, number) + name.encode())

    def record(self, number, layout, seconds, *values):
        """Add a record."""
        stamp = self.start + round(1e6 * seconds)
        self.message("D", struct.pack(f"<HQ{layout}", number, stamp, *values))


def flight():
    """A log as PX4 writes it, of signals in the axes NED and FRD, with doubles; and the signals in ENU and FLU."""
    enu = {name: RNG.normal(size=len(T)) for name in ("x", "y", "z", "vx", "vy", "vz", "wx", "wy", "wz", "motor1")}
    q = RNG.normal(size=(len(T), 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    file = Ulog()
    file.keyed("I", "char[3] sys_name", b"PX4")
    file.keyed("P", "float MC_ROLL_P", struct.pack("<f", 6.5))
    for name, fields in {
        "vehicle_local_position": "double[3] p;double[3] v;bool xy_valid;bool z_valid;bool v_xy_valid;bool v_z_valid;",
        "vehicle_attitude": "double[4] q;",
        "vehicle_angular_velocity": "uint64_t timestamp_sample;double[3] xyz;",
        "actuator_motors": "double[4] control;uint8_t[2] _padding0;",
    }.items():
        own = fields.replace("double[3] p", "double x;double y;double z")
        file.format(name, "uint64_t timestamp;" + own.replace("double[3] v;", "double vx;double vy;double vz;"))
        file.subscribe(len(file.topics), name)
        file.topics[name] = len(file.topics)
    file.message("O", struct.pack("<H", 30))
    file.message("L", b"4" + struct.pack("<Q", file.start) + b"takeoff")
    file.message("S", bytes.fromhex("2f731320250cbb12"))
    for k, t in enumerate(T):
        x, y, z, vx, vy, vz, wx, wy, wz, motor = (enu[name][k] for name in enu)
        if k % 4 == 0:
            file.record(0, "6d4?", t, y, x, -z, vy, vx, -vz, *(k % 8 == 0,) * 2, True, True)
        file.record(1, "4d", t, *q[k])
        stamp = file.start + round(1e6 * t)
        file.record(2, "Q3d", t + 0.002, stamp, wx, -wy, -wz)
        file.record(3, "4d", t, motor, 0.5, 0.5, 0.5)
    return file.data, enu, q


def write_mcap(path, compression=None, stop=None):
    """JSON and ROS 2 messages, as the library of MCAP writes them."""
    writer_of = pytest.importorskip("mcap.writer", reason="NOT CHECKED: mcap is missing")
    typesys = pytest.importorskip("rosbags.typesys", reason="NOT CHECKED: rosbags is missing")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    kind = "sensor_msgs/msg/JointState"
    definition, _ = store.generate_msgdef(kind, ros_version=2)
    options = {} if compression is None else {"compression": compression}
    with path.open("wb") as file:
        writer = writer_of.Writer(file, chunk_size=4000, **options)
        writer.start()
        schema = writer.register_schema(kind, "ros2msg", definition.encode())
        joints = writer.register_channel("/joint_states", "cdr", schema)
        plain = writer.register_channel("/command", "json", writer.register_schema("command", "jsonschema", b"{}"))
        for k in range(len(T)):
            data = bytes(store.serialize_cdr(joint_state(store, kind, k), kind))
            writer.add_message(joints, nanoseconds(k) + 300_000, data, nanoseconds(k))
            text = json.dumps({"u": {"force": EFFORT[k]}, "on": True}).encode()
            writer.add_message(plain, nanoseconds(k), text, nanoseconds(k))
        if stop is None:
            writer.finish()


def joint_state(store, kind, k):
    """Message k; its joints are in another order from message 100 on."""
    types = store.types
    time = types["builtin_interfaces/msg/Time"](sec=nanoseconds(k) // 10**9, nanosec=nanoseconds(k) % 10**9)
    extra = {"seq": k} if "ROS1" in repr(store) or "seq" in types["std_msgs/msg/Header"].__dataclass_fields__ else {}
    header = types["std_msgs/msg/Header"](stamp=time, frame_id="", **extra)
    order = [0, 1] if k < 100 else [1, 0]
    arrays = {"name": ["elbow", "wrist"], "position": np.array([X[k], 1.0]), "velocity": np.array([V[k], 2.0])}
    arrays["effort"] = np.array([EFFORT[k], 3.0])
    arrays = {name: [values[i] for i in order] for name, values in arrays.items()}
    return types[kind](header=header, **{n: x if n == "name" else np.array(x) for n, x in arrays.items()})


def write_bag(path, version):
    typesys = pytest.importorskip("rosbags.typesys", reason="NOT CHECKED: rosbags is missing")
    kind = "sensor_msgs/msg/JointState"
    if version == 1:
        from rosbags.rosbag1 import Writer

        store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC)
        encode, writer = store.serialize_ros1, Writer(path)
    else:
        from rosbags.rosbag2 import StoragePlugin, Writer

        store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        encode = store.serialize_cdr
        writer = Writer(path, version=9, storage_plugin=StoragePlugin[version])
    with writer:
        connection = writer.add_connection("/joint_states", kind, typestore=store)
        for k in range(len(T)):
            writer.write(connection, nanoseconds(k), bytes(encode(joint_state(store, kind, k), kind)))
