"""What `mrbokeh host nuke|natron|fusion` writes, against stand-ins for the programs and a real server: none of them was run here.

The stand-ins are as the programs' documentation has them: what they do not know raises an error.
"""

import ast
import importlib.util
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mrbokeh
from mrbokeh.commands.host import Program, written
from mrbokeh.hosts import client
from mrbokeh.images.exr_io import ExrPart, read_exr, write_exr
from mrbokeh.optics.lens import Lens

SIZE = (20, 30)
RGB = np.random.default_rng(1).uniform(0.0, 1.0, (*SIZE, 3)).astype(np.float32)
DEPTH_M = np.where(np.arange(30) < 12, np.float32(1.0), np.float32(5.0)) * np.ones(SIZE, np.float32)


def wanted() -> np.ndarray:
    return mrbokeh.render(RGB, DEPTH_M, Lens(50.0, 2.0), focus=1.0)


def loaded(program: Program, folder: Path) -> Any:
    """The module as the program imports it."""
    path = folder / f"mrbokeh_{program}.py"
    path.write_text(written(program), encoding="utf-8")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def write_sharp(path: str) -> None:
    write_exr(path, ExrPart({**{name: RGB[..., i] for i, name in enumerate("RGB")}, "depth.Z": DEPTH_M}))


class Knob:
    """A knob of Nuke."""

    def __init__(self, name: str, *rest: Any) -> None:
        self.name, self.rest, self.held, self.pressed = name, rest, 0.0 if not rest else "", 0

    def setValue(self, value: Any) -> None:  # noqa: N802
        self.held = value

    def valueAt(self, _: float) -> Any:  # noqa: N802
        return self.held

    def value(self) -> Any:
        return self.held

    evaluate = value

    def setTooltip(self, _: str) -> None: ...  # noqa: N802

    def execute(self) -> None:
        self.pressed += 1


class Node:
    """A node of Nuke; knobs of built-in nodes come as they are asked for."""

    def __init__(self, kind: str) -> None:
        self.kind, self.label, self.knobs, self.inputs, self.inside = kind, kind, dict[str, Knob](), dict[int, Any](), list[Any]()

    def setName(self, name: str) -> None:  # noqa: N802
        self.label = name

    def name(self) -> str:
        return self.label

    def addKnob(self, knob: Knob) -> None:  # noqa: N802
        self.knobs[knob.name] = knob

    def setInput(self, index: int, node: Any) -> None:  # noqa: N802
        self.inputs[index] = node

    def node(self, name: str) -> Any:
        return next(each for each in self.inside if each.label == name)

    def __getitem__(self, name: str) -> Knob:
        return self.knobs[name] if self.kind == "Group" else self.knobs.setdefault(name, Knob(name))


def test_nuke_blurs_a_frame(connection: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MRBOKEH_SERVER", connection)
    groups, said, menus = list[Any](), list[str](), list[tuple[str, ...]]()

    def create(kind: str, inpanel: bool) -> Node:  # noqa: ARG001
        made = Node(kind)
        (groups[-1].inside if groups else groups).append(made)
        made.begin = made.end = lambda: None  # type: ignore[attr-defined]
        return made

    nuke = types.ModuleType("nuke")
    menu = types.SimpleNamespace(addMenu=lambda _: menu, addCommand=lambda *words: menus.append(words))
    vars(nuke).update(createNode=create, message=said.append, GUI=True, menu=lambda _: menu)
    vars(nuke).update({f"{kind}_Knob": Knob for kind in ("Tab", "Double", "File", "String", "Enumeration", "PyScript")})
    vars(nuke)["execute"] = lambda node, first, _: write_sharp(node["file"].value() % first)
    monkeypatch.setitem(sys.modules, "nuke", nuke)
    module = loaded(Program.NUKE, tmp_path)
    assert menus == [("Lens Blur", "import mrbokeh_nuke; mrbokeh_nuke.create()")]
    group = module.create()
    assert [each.kind for each in group.inside] == ["Input", "Expression", "Write", "Read", "Output"]
    assert "mrbokeh_nuke.blur(nuke.thisNode(), nuke.frame()" in group["blur_frame"].rest[-1]
    group["focus"].setValue(1.0)
    group["folder"].setValue(str(tmp_path / "frames"))
    module.blur(group, 7, 7)
    assert not said, said
    shown = group.node("blurred")
    assert (shown["first"].value(), shown["last"].value(), shown["reload"].pressed) == (7, 7, 1)
    assert [each.name for each in (tmp_path / "frames").iterdir()] == ["mrbokeh1_blurred.0007.exr"]
    found = read_exr(shown["file"].value() % 7)[0].stacked("RGB")
    np.testing.assert_array_equal(found, wanted().astype(np.float16).astype(np.float32))
    group["lens"].setValue("none.json")
    module.blur(group, 7, 7)
    assert said[0].startswith("mrbokeh: expected a lens file") and shown["reload"].pressed == 1


def test_natron_blurs_the_frame_at_the_playhead(connection: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MRBOKEH_SERVER", connection)

    class Parameter:
        def __init__(self, name: str) -> None:
            self.name, self.held, self.reloaded = name, "", 0

        def get(self, frame: int | None = None) -> Any:  # noqa: ARG002
            return self.held

        def setValue(self, value: Any) -> None:  # noqa: N802
            self.held = value

        setDefaultValue = setValue

        def getScriptName(self) -> str:  # noqa: N802
            return self.name

        def reloadFile(self) -> None:  # noqa: N802
            self.reloaded += 1

        def addParam(self, _: Any) -> None: ...  # noqa: N802

    class Effect:
        def __init__(self) -> None:
            self.held, self.nodes = {name: Parameter(name) for name in ("onParamChanged", "filename")}, dict[str, Any]()

        def _made(self, name: str, _label: str) -> Parameter:
            return self.held.setdefault(name, Parameter(name))

        createPageParam = createDoubleParam = createStringParam = createButtonParam = _made

        def getParam(self, name: str) -> Parameter:  # noqa: N802
            return self.held[name]

        def getNode(self, name: str) -> Any:  # noqa: N802
            return self.nodes[name]

        def setPagesOrder(self, _: Any) -> None: ...  # noqa: N802
        def refreshUserParamsGUI(self) -> None: ...  # noqa: N802
        def connectInput(self, _: int, __: Any) -> None: ...  # noqa: N802

    said, group = list[str](), Effect()

    def create(_kind: str, _version: int, inside: Effect) -> Effect:
        made = Effect()
        vars(made)["setScriptName"] = lambda name: inside.nodes.update({name: made})
        return made

    app = types.SimpleNamespace(createNode=create, timelineGetTime=lambda: 3, writeToScriptEditor=said.append)
    module = loaded(Program.NATRON, tmp_path)
    module.createInstance(app, group)
    assert (module.getPluginID(), group.getParam("onParamChanged").get()) == ("mrbokeh.LensBlur", "mrbokeh_natron.changed")
    write_sharp(str(tmp_path / "in.0003.exr"))
    group.getParam("picture").setValue(str(tmp_path / "in.####.exr"))
    group.getParam("focus").setValue(1.0)
    module.changed(group.getParam("blur"), group, None, app, True)
    shown = group.getNode("blurred").getParam("filename")
    assert not said and shown.reloaded == 1, said
    np.testing.assert_array_equal(read_exr(shown.get())[0].stacked("RGB"), wanted().astype(np.float16).astype(np.float32))
    group.getParam("picture").setValue("none.exr")
    module.changed(group.getParam("blur"), group, None, app, True)
    assert said == ["mrbokeh: expected an EXR file at none.exr, but there is none"]


_FUSION = """
CT_Tool = "tool"
inputs, printed = {}, {}
function FuRegisterClass(name, kind, about) registered = name end
function print(text) printed[#printed + 1] = text end
function Pixel() return { R = 0, G = 0, B = 0, A = 0, Z = 0 } end
function Image(about)
    local like, made = about.IMG_Like, { Width = about.IMG_Like.Width, Height = about.IMG_Like.Height, held = {} }
    function made:SetPixel(x, y, p) self.held[y * self.Width + x] = { p.R, p.G, p.B, p.A, p.Z } end
    return made
end
self = {}
function self:AddInput(label, name, about)
    local input = { value = { Value = about.INP_Default } }
    function input:GetValue(req) return self.value end
    inputs[name] = input
    return input
end
function self:AddOutput(label, name, about)
    return { Set = function(_, req, image) output = image end }
end
"""


@pytest.fixture
def fusion() -> Callable[[str], Any]:
    """Fusion's own Lua, LuaJIT, with as much of Fusion as a Fuse needs; `run(name)` processes and returns the globals."""
    lupa = pytest.importorskip("lupa.luajit21", reason="lupa, the Lua of the extra dev, is not installed")
    lua = lupa.LuaRuntime(unpack_returned_tuples=True)
    lua.execute(_FUSION)
    # Fusion counts rows from the bottom, and its 3D renderer has negative Z.
    upwards = np.dstack([RGB, np.full(SIZE, 0.5, np.float32), -DEPTH_M])[::-1]
    rows = lua.table_from([lua.table_from(map(float, pixel)) for pixel in upwards.reshape(-1, 5)])
    lua.globals().rows, lua.globals().width, lua.globals().height = rows, SIZE[1], SIZE[0]
    lua.execute(
        "image = { Width = width, Height = height }\n"
        "function image:GetPixel(x, y, p) p.R, p.G, p.B, p.A, p.Z = unpack(rows[y * width + x + 1]) end"
    )
    lua.execute(written(Program.FUSION))
    lua.execute("Create(); inputs.Input.value = image")

    def run(setup: str) -> Any:
        lua.execute(setup + "\noutput = nil; Process({})")
        return lua.globals()

    return run


def test_fusion_blurs_while_it_renders(
    fusion: Callable[[str], Any], connection: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MRBOKEH_SERVER", connection)
    monkeypatch.setenv("TEMP", str(tmp_path))
    ran = fusion("inputs.focus.value = { Value = 1.0 }")
    assert ran.registered == "mrbokehLensBlur" and ran.output is not None, list(ran.printed.values())
    held = np.array([list(ran.output.held[i].values()) for i in range(RGB[..., 0].size)], np.float32).reshape(*SIZE, 5)[::-1]
    np.testing.assert_array_equal(held[..., :3], wanted())
    assert (held[..., 3] == 0.5).all() and (held[..., 4] == -DEPTH_M).all() and not list(tmp_path.iterdir())
    # A mistake ends the render with its sentence.
    ran = fusion("inputs.lens.value = { Value = 'no \"lens\" \\\\ here' }")
    assert ran.output is None and "expected a lens file" in list(ran.printed.values())[-1] and not list(tmp_path.iterdir())
    monkeypatch.setenv("MRBOKEH_SERVER", str(tmp_path / "none.json"))
    ran = fusion("")
    assert ran.output is None and "start `mrbokeh serve`" in list(ran.printed.values())[-1]


@pytest.mark.parametrize("program", [Program.NUKE, Program.NATRON, None])
def test_python_of_old_hosts(program: Program | None) -> None:
    """Python 3.7, as of Nuke 13; the standard library, numpy, and the program's own module."""
    text = Path(client.__file__).read_text(encoding="utf-8") if program is None else written(program)
    tree = ast.parse(text, feature_version=(3, 7))
    imported = {name.name.partition(".")[0] for node in ast.walk(tree) if isinstance(node, ast.Import) for name in node.names}
    assert imported <= {"http", "json", "os", "tempfile", "numpy", "nuke"} and "http" in imported
    assert not [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
