"""Texts that end comments and strings, control terminals, or are words of a language; files that lie beside a log."""

import diransac as dr

CODE = "__attribute__((constructor)) static void evil(void) { abort(); }"
"""C that ends the program in which it is compiled."""

TEXTS = {
    "backslash": "m\\",
    "trigraph": "m??/",
    "end of comment": f"m */ {CODE} /*",
    "spliced end": f"m *\\\n/ {CODE} /*",
    "trigraph in end": f"m *??/\n/ {CODE} /*",
    "begin of comment": "m /* /*/ //",
    "line": f"m\n{CODE}",
    "preprocessor": f"m\n#error evil\n*/\n#error evil\n{CODE}",
    "carriage return": f"m\r*/{CODE}\r\n",
    "nul": "m\0s",
    "escape": "m\x1b[2J\x1b]0;evil\x07",
    "delete": "m\x7f",
    "c1": "m\x9b2J\x85\x90evil\x9c",
    "line separator": "m\u2028import evil\u2029",
    "bidirectional": "m\u202e\u2066evil\u2069",
    "surrogate": "m\udc9b",
    "no character": "m\uffff\U000e0001",
    "byte order mark": "\ufeffm",
    "quotes": "m\"'`",
    "docstring": 'm"""\nraise SystemExit("evil")\n"""',
    "docstring ends": 'm"""',
    "percent": "%s%n{0}{__class__}%",
    "xml": "]]><!-- -- --><evil a=\"'&amp;",
    "yaml": "m\n- evil: !!python/object/apply:os.abort []\n# : \t[{",
    "formula": '=HYPERLINK("http://evil","m")',
    "markup": "[bold red]m[/] [link=file:///evil]m[/link]",
    "mathematics": r"$\frac{$m^",
    "long": "m" * 5000,
    "empty": "",
    "greek": "µ·rad/s² °",
    "outside": "\U0001d6fc",
}

SECOND_LINES = tuple({line[:12] for text in TEXTS.values() for line in text.split("\n")[1:] if line.strip(' "')})
"""Beginnings of the lines that a text with line breaks would add to what is printed."""

NAMES = (
    "derivative", "derivative_of", "step", "parameters", "np", "STATES", "INPUTS", "PARAMETERS", "dt", "w0",
    "double", "void", "main", "printf", "sin", "INFINITY", "NAN", "template", "operator", "requires", "print", "list",
    "match", "type", "self", "null", "true", "yes", "NO", "on", "y", "jac", "hess", "e1", "inf", "nan", "_b", "a__b",
    "µ", "\U0001d6fc", "l" * 5000,
)  # fmt: skip
"""Names that a model may have, and that the files of its exports use themselves, or languages do."""

# Files that lie in a working directory: modules, libraries, settings, and a description of which MuJoCo warns.
MODULES = (
    "numpy", "scipy", "casadi", "polars", "mujoco", "matplotlib", "h5py", "dask", "distributed", "llvmlite", "sqlite3",
    "pickle", "struct", "socket", "logging", "sitecustomize", "usercustomize",
)  # fmt: skip
LIBRARIES = (
    "libcasadi_nlpsol_ipopt.so", "libipopt.so.3", "libhsl.so", "libcoinhsl.so",
    "libllvmlite.so", "libmujoco.so", "libgomp.so.1", "plugin/libh5.so", "mujoco_plugin/libplugin.so",
)  # fmt: skip
SETTINGS = {
    "ipopt.opt": "output_file ran-ipopt\nprint_level 5\nlinear_solver ma27\nhsllib ./libhsl.so\n",
    "matplotlibrc": "figure.dpi: 7\nbackend: module://pickle\ntext.usetex: True\n",
    "dask.yaml": "planted: true\n",
    "distributed.yaml": "planted: true\n",
    ".dask/dask.yaml": "planted: true\n",
    ".config/dask/dask.yaml": "planted: true\n",
    ".sqliterc": ".system touch ran-sqlite\n",
    ".numba_config.yaml": "disable_jit: 1\n",
    "polars.toml": "verbose = 1\n",
    "pyvenv.cfg": "home = .\n",
}
URDF = """<robot name="r"><link name="w"/><link name="b"><inertial><mass value="1"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="e" type="revolute">
<parent link="w"/><child link="b"/><axis xyz="0 1 0"/><limit lower="0" upper="0" effort="1" velocity="1"/></joint>
</robot>
"""


def named(text: str = "m", names: tuple[str, ...] = ("x", "push", "mass", "drag")) -> dr.Model:
    """A driven mass with drag whose units and name are a text, and whose coordinate, input and parameters have names.

    Its acceleration is (push - drag v) / mass.
    """
    coordinate, push, mass, drag = names
    return dr.Model(
        text or "m",
        {coordinate: text},
        {push: text},
        {mass: dr.Parameter(text, positive=True), drag: dr.Parameter(text)},
        lambda q, v, a, u, p: [p[mass] * a[coordinate] + p[drag] * v[coordinate] - u[push]],
    )
