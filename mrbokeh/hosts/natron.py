# SPDX-License-Identifier: Apache-2.0
"""Natron (2.4 and later): a PyPlug that blurs through a running `mrbokeh serve`.

Put this file into a folder of Natron's search path for plug-ins, as mrbokeh_natron.py. The node mrbokeh > Lens Blur is told an EXR
with R, G, B and Z in metres (#### for the frame, `picture.####.exr`), for Natron's own writer keeps no depth. Blur writes
`picture.0001.mrbokeh.exr` beside it, which the node shows. Mistakes are told in the Script Editor.
"""

import os

from mrbokeh.hosts.client import Refused, ask, frame_request

NUMBERS = (
    ("focus", "Focus (metres)", 2.0),
    ("focal_length_mm", "Focal length (mm)", 50.0),
    ("f_number", "f-number", 2.0),
    ("sensor_width_mm", "Sensor width (mm)", 36.0),
)
TEXTS = (("picture", "Picture (EXR with Z)"), ("lens", "Lens"), ("renderer", "Renderer"))


def getPluginID():  # type: ignore[no-untyped-def]  # noqa: N802
    return "mrbokeh.LensBlur"


def getLabel():  # type: ignore[no-untyped-def]  # noqa: N802
    return "Lens Blur"


def getVersion():  # type: ignore[no-untyped-def]  # noqa: N802
    return 1


def getGrouping():  # type: ignore[no-untyped-def]  # noqa: N802
    return "mrbokeh"


def getPluginDescription():  # type: ignore[no-untyped-def]  # noqa: N802
    return "Blurs a render with depth as a lens does, through a running `mrbokeh serve`."


def createInstance(app, group):  # type: ignore[no-untyped-def]  # noqa: N802
    """Fill the group with parameters, a reader of the result, and its output; called by Natron."""
    page = group.createPageParam("mrbokeh", "mrbokeh")
    for name, label, value in NUMBERS:
        number = group.createDoubleParam(name, label)
        number.setDefaultValue(value)
        page.addParam(number)
    for name, label in TEXTS:
        page.addParam(group.createStringParam(name, label))
    page.addParam(group.createButtonParam("blur", "Blur this frame"))
    group.setPagesOrder(["mrbokeh", "Node", "Settings"])
    reader = app.createNode("fr.inria.openfx.ReadOIIO", -1, group)
    reader.setScriptName("blurred")
    output = app.createNode("fr.inria.built-in.Output", 1, group)
    output.connectInput(0, reader)
    group.refreshUserParamsGUI()
    group.getParam("onParamChanged").setValue("mrbokeh_natron.changed")


def changed(thisParam, thisNode, thisGroup, app, userEdited):  # type: ignore[no-untyped-def]  # noqa: ARG001
    """Blur when the button is pressed; called by Natron whenever a parameter changes."""
    if thisParam.getScriptName() == "blur":
        blur(thisNode, app)


def blur(node, app):  # type: ignore[no-untyped-def]
    """Ask the server for the frame at the playhead."""
    frame = int(app.timelineGetTime())
    values = {name: node.getParam(name).get(frame) for name, _, _ in NUMBERS}
    values.update({name: node.getParam(name).get() for name, _ in TEXTS})
    sharp = (values.pop("picture") or "").replace("####", f"{frame:04d}")
    out = os.path.splitext(sharp)[0] + ".mrbokeh.exr"
    try:
        ask(frame_request(values, sharp, out))
    except Refused as error:
        app.writeToScriptEditor("mrbokeh: " + str(error))
    else:
        reader = node.getNode("blurred")
        reader.getParam("filename").setValue(out)
        reader.getParam("filename").reloadFile()
