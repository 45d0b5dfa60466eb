# SPDX-License-Identifier: Apache-2.0
"""Nuke (13 and later): a group that blurs through a running `mrbokeh serve`.

Put this file into ~/.nuke and write `import mrbokeh_nuke` into ~/.nuke/menu.py: Nodes > mrbokeh > Lens Blur. Connect a picture with
depth.Z and press a button: the frames are written as EXR, blurred by the server, and shown by the group.
"""

import os
import tempfile

from mrbokeh.hosts.client import Refused, ask, frame_request

NUMBERS = (
    ("focus", "focus (metres)", 2.0),
    ("focal_length_mm", "focal length (mm)", 50.0),
    ("f_number", "f-number", 2.0),
    ("sensor_width_mm", "sensor width (mm)", 36.0),
)
DEPTHS = ("metres", "1 / metres (ScanlineRender)")
LENSES = "A lens file, a bank of kernels (its folder), a network (.onnx) or a name of `mrbokeh lens list`; empty for a round opening"
_PRESSED = "import mrbokeh_nuke; mrbokeh_nuke.blur(nuke.thisNode(), {})"


def create():  # type: ignore[no-untyped-def]
    """Make the group; called by the menu."""
    import nuke

    group = nuke.createNode("Group", inpanel=True)
    group.setName("mrbokeh1")
    group.addKnob(nuke.Tab_Knob("mrbokeh", "mrbokeh"))
    for name, label, value in NUMBERS:
        group.addKnob(nuke.Double_Knob(name, label))
        group[name].setValue(value)
    group.addKnob(nuke.File_Knob("lens", "lens"))
    group["lens"].setTooltip(LENSES)
    group.addKnob(nuke.String_Knob("renderer", "renderer"))
    group.addKnob(nuke.Enumeration_Knob("depth_is", "depth is", list(DEPTHS)))
    group.addKnob(nuke.File_Knob("folder", "folder of frames"))
    group["folder"].setValue(os.path.join(tempfile.gettempdir(), "mrbokeh").replace("\\", "/"))
    for name, label, frames in (
        ("blur_frame", "Blur this frame", "nuke.frame(), nuke.frame()"),
        ("blur_all", "Blur all frames", "nuke.root().firstFrame(), nuke.root().lastFrame()"),
    ):
        group.addKnob(nuke.PyScript_Knob(name, label, _PRESSED.format(frames)))
    group.begin()
    source = nuke.createNode("Input", inpanel=False)
    metres = _inside("Expression", "metres", source, channel0="depth")
    metres["expr0"].setValue("parent.depth_is == 1 ? (depth.Z > 0 ? 1 / depth.Z : 0) : depth.Z")
    _inside("Write", "sharp", metres, file_type="exr", channels="all", datatype="32 bit float", compression="none", raw=True)
    blurred = _inside("Read", "blurred", None, raw=True, on_error="nearest frame")
    _inside("Output", "Output1", blurred)
    group.end()
    return group


def _inside(kind, name, source, **values):  # type: ignore[no-untyped-def]
    import nuke

    node = nuke.createNode(kind, inpanel=False)
    node.setName(name)
    if source is not None:
        node.setInput(0, source)
    for knob, value in values.items():
        node[knob].setValue(value)
    return node


def blur(group, first, last):  # type: ignore[no-untyped-def]
    """Write the frames, ask the server for each, and show the results; a mistake is one sentence in a window."""
    import nuke

    try:
        folder = group["folder"].evaluate() or tempfile.gettempdir()
        if not os.path.isdir(folder):
            os.makedirs(folder)
        names = [os.path.join(folder, group.name() + which + ".%04d.exr").replace("\\", "/") for which in ("_sharp", "_blurred")]
        group.node("sharp")["file"].setValue(names[0])
        for frame in range(int(first), int(last) + 1):
            sharp, out = (name % frame for name in names)
            nuke.execute(group.node("sharp"), frame, frame)
            values = {name: group[name].valueAt(frame) for name, _, _ in NUMBERS}  # they may be animated
            values.update(lens=group["lens"].value(), renderer=group["renderer"].value())
            ask(frame_request(values, sharp, out))
            os.remove(sharp)
        shown = group.node("blurred")
        shown["file"].setValue(names[1])
        for knob, frame in (("first", first), ("last", last), ("origfirst", first), ("origlast", last)):
            shown[knob].setValue(int(frame))
        shown["reload"].execute()
    except (Refused, OSError, RuntimeError) as error:
        nuke.message("mrbokeh: " + str(error))


def add_menu():  # type: ignore[no-untyped-def]
    """Put the node into Nuke's menu; nothing where there is no window."""
    import nuke

    if nuke.GUI:
        nuke.menu("Nodes").addMenu("mrbokeh").addCommand("Lens Blur", "import mrbokeh_nuke; mrbokeh_nuke.create()")


if __name__ == "mrbokeh_nuke":
    add_menu()
