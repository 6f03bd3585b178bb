"""Files that declare enormous sizes, places that are no files, and models that no machine has, for the fuzzer."""

import gzip
import io
import json
import os
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from random import Random

import numpy as np

from fuzzing import Kind, as_json, signed

MOST_MEMORY = 2**32
"""Bytes that a command over a file of any size may take."""

_LENGTHS = (0, 1, 2, 40, 10_000, 1_000_000, 9_999_999, 10_000_001, 2**27, 2**31, 2**33, 2**62)


# Logs -----------------------------------------------------------------------------------------------------------------
def _shape(rng: Random) -> tuple[int, ...]:
    return tuple(rng.choice(_LENGTHS) for _ in range(rng.choice((1, 1, 2, 2, 3))))


def sized_npz(data: bytes, rng: Random) -> bytes:
    """An NPZ file with further arrays of which the headers are all that is true, or that are zeros."""
    file = io.BytesIO(data)
    with zipfile.ZipFile(file, "a", zipfile.ZIP_DEFLATED) as archive:
        for k in range(rng.choice((1, 1, 2, 300, 11_000))):
            head, kind, shape = (
                io.BytesIO(),
                rng.choice(("|b1", "<f8", "|i1", "<U9", "<U99999999", "<c16")),
                _shape(rng),
            )
            if rng.random() < 0.3 and k < 3:
                kind, shape = "|b1", (rng.choice((10**6, 10**7, 2**27)),)
            np.lib.format.write_array_header_1_0(
                head, {"descr": kind, "fortran_order": rng.random() < 0.5, "shape": shape}
            )
            body = bytes(shape[0]) if kind == "|b1" and len(shape) == 1 and shape[0] <= 2**27 and k < 3 else b""
            archive.writestr(f"y{k}.npy", head.getvalue() + body)
    return file.getvalue()


def sized_hdf5(data: bytes, rng: Random) -> bytes:
    """An HDF5 file with datasets of any declared size, virtual ones, external ones, and loops of links."""
    import h5py

    file = io.BytesIO(data)
    with h5py.File(file, "r+") as opened:
        for k in range(rng.choice((1, 1, 2, 5))):
            kind, shape = rng.choice(("i1", "f8", "f4", "?", "S9")), _shape(rng)
            match rng.randrange(5):
                case 0:
                    layout = h5py.VirtualLayout(shape=(80,), dtype="f8")
                    layout[:] = h5py.VirtualSource(rng.choice((".", "log.h5", "/dev/zero")), f"y{k}", shape=(80,))
                    opened.create_virtual_dataset(f"y{k}", layout)
                case 1:
                    opened.create_dataset(f"y{k}", (80,), "i1", external=[("/dev/zero", 0, 80)])
                case 2:
                    groups = [opened.create_group(f"g{k}.{i}") for i in range(rng.choice((1, 3, 14)))]
                    for i in range(rng.choice((10, 300))):
                        rng.choice(groups)[f"to{i}"] = rng.choice(groups)
                case _:
                    chunks = tuple(min(max(n, 1), rng.choice((1, 100, 2**16))) for n in shape)
                    if all(shape) and np.prod(chunks, dtype=float) < 2**28:
                        opened.create_dataset(f"y{k}", shape, kind, chunks=chunks)
    return file.getvalue()


def sized_gzip(data: bytes, rng: Random) -> bytes:
    """Compressed text with a part repeated up to a gigabyte."""
    part = rng.choice((b"\n", b"0", b"1,2,3,4\n", b",", b'"', b"\0", b"1,", data[:300]))
    times = rng.choice((10, 10**4, 10**6, 10**7, 10**8)) // len(part)
    text = data + part * times if rng.random() < 0.5 else part * times + data
    return gzip.compress(text, 1)


# Models ---------------------------------------------------------------------------------------------------------------
_ATTRIBUTES = ("count", "nrow", "ncol", "width", "height", "memory", "nuserdata", "nkey", "size", "mass", "damping")


def sized_robot(data: bytes, rng: Random) -> bytes:
    """A description with repeated bodies, fields of heights, textures and numbers of any size."""
    n, m = (rng.choice(("0", "-1", "3", "70", "3000", "100000", "4000000000", "1e300", "nan", "x")) for _ in range(2))
    body = '<body><joint type="hinge" damping="1"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body>'
    added = rng.choice(
        (
            f'<worldbody><replicate count="{n}">{body}</replicate></worldbody>',
            f'<worldbody><replicate count="{n}"><replicate count="{m}">{body}</replicate></replicate></worldbody>',
            f'<asset><hfield name="h" nrow="{n}" ncol="{m}" size="1 1 1 1"/></asset>'
            '<worldbody><geom type="hfield" hfield="h"/></worldbody>',
            f'<asset><texture name="t" type="2d" builtin="flat" width="{n}" height="{m}"/></asset>',
            f'<worldbody><flexcomp name="f" type="grid" count="{n} {m} 1" spacing="1 1 1" mass="1"/></worldbody>',
            f'<size memory="{n}"/>',
            f'<size nuserdata="{n}" nkey="{m}"/>',
            f'<include file="{rng.choice(("arm.xml", "/dev/zero", "none.xml", "/dev/stdin"))}"/>',
            f'<worldbody><body><joint type="hinge" armature="{n}" damping="{m}"/>'
            f'<inertial pos="0 0 {n}" mass="{m}" diaginertia="1 1 1"/></body></worldbody>',
        )
    )
    return data.replace(b"</mujoco>", added.encode() + b"</mujoco>")


def sized_graph(data: bytes, rng: Random) -> bytes:
    """A result whose equations have a chain of further operations, or lists within lists."""
    result = json.loads(data)
    if rng.random() < 0.3:
        nest: list[object] = []
        for _ in range(rng.choice((50, 90, 200, 900))):
            nest = [nest]
        result[rng.choice(list(result))] = nest
        return as_json(signed(result)).encode()
    graph = result["model"]["residual"]
    lines, (name, (out, *more)) = graph["operations"], next(iter(graph["results"].items()))
    last = rng.randrange(len(lines))
    for _ in range(rng.choice((100, 3000, 50_000, 190_000))):
        word = rng.choice(("sin", "neg", "sq")) if rng.random() < 0.7 else "add"
        lines.append(f"{len(lines)} = {word} {last}" + (f" {rng.randrange(len(lines))}" if word == "add" else ""))
        last = len(lines) - 1
    lines.append(f"{len(lines)} = add {out} {last}")
    graph["results"][name] = [len(lines) - 1, *more]
    return as_json(signed(result)).encode()


_MODEL = """import casadi as ca
import diransac as dr

class Own(BaseException):
    pass

class Silent(Exception):
    def __str__(self):
        raise Own

def equations(q, v, a, u, p):
    {before}
    return [p.mass * a.x + p.drag * v.x {term} - {gain} * u.thrust]

model = dr.Model({name}, {{"x": "m"}}, {inputs}, {{"mass": dr.Parameter({mass}), "drag": dr.Parameter("1")}}, equations)
"""
_USUAL = {"before": "pass", "term": "", "gain": "1.0", "name": '"own"', "inputs": '{"thrust": "N"}', "mass": '"kg"'}
_UNUSUAL = {
    "before": (
        "raise Own('x')", "raise Silent", "raise SystemExit(3)", "raise GeneratorExit", "raise MemoryError",
        "raise OSError(5, 'x')",
        "return equations(q, v, a, u, p)", "raise Warning('a\\nb')", "return None", "raise StopIteration", "p = None",
        "print('x' * 10000)", "assert False",
    ),
    "term": ("+ 1e300 * q.x", "+ ca.exp(1e3 * q.x)", "/ 0", "+ q.x / 1e-300", "+ p.mass ** 300", "+ ca.log(-q.x ** 2)"),
    "gain": ("0.0", "1e300", "1e-300", "float('inf')", "float('nan')", "-1e154", "1e308"),
    "name": ("5", "None", "'$x_{{$'", "'a\\nb'", "b'x'", "''", "'x' * 10000"),
    "inputs": ("{{}}", "{{'thrust': 5}}", "{{5: 'N'}}", "None", "[]", "{{'thrust': 'N', 'y': 'N'}}"),
    "mass": (
        "5", "'kg', 1e300, 1.1e300", "'kg', 1e9, 2e9", "'kg', -1e308, 1e308", "'kg', 1e-300, 1e-299", "'kg', 3, 2",
        "'kg', float('nan')",
        "'kg', 1e150, 1e151, True", "'kg', value=1e300", "None",
    ),
}  # fmt: skip


def model_text(changes: Mapping[str, str] | None = None) -> bytes:
    """A model file."""
    return _MODEL.format(**_USUAL | dict(changes or {})).encode()


def odd_model(_: bytes, rng: Random) -> bytes:
    """A model file with one to three parts that no machine has."""
    names = rng.sample(list(_UNUSUAL), rng.choice((1, 1, 2, 3)))
    return model_text({name: rng.choice(_UNUSUAL[name]).replace("{{", "{").replace("}}", "}") for name in names})


# Places ---------------------------------------------------------------------------------------------------------------
_LINKS = {"device": "/dev/zero", "loop": "", "stdin": "/proc/self/fd/0", "dangling": "no/such/place"}
PLACES = ("file", "pipe", "folder", "hole", "nothing", *_LINKS)


@dataclass(frozen=True)
class Place(Kind):
    """A name that stands for something else than a file, as its data say; a file holds `content`."""

    content: bytes = b""

    def place(self, folder: Path, data: bytes) -> None:
        """Make what the data say."""
        for name, content in self.beside.items():
            (folder / name).write_bytes(content)
        path, kind = folder / self.name, data.decode()
        if path.is_dir() and not path.is_symlink():
            path.rmdir()
        else:
            path.unlink(missing_ok=True)
        if kind in _LINKS:
            path.symlink_to(_LINKS[kind] or path.name)
        elif kind == "folder":
            path.mkdir()
        elif kind == "pipe":
            os.mkfifo(path)
        elif kind != "nothing":
            path.write_bytes(self.content)
            os.truncate(path, 1 << 40 if kind == "hole" else len(self.content))


def another_place(_: bytes, rng: Random) -> bytes:
    """A kind of place."""
    return rng.choice(PLACES[1:]).encode()
