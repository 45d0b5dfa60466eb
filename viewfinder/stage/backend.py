"""Backend: the SceneRenderer protocol in a form that can be checked while the program runs, as the tests do for every annotation."""

from typing import Protocol, runtime_checkable

from mrbokeh.scene import SceneRenderer


@runtime_checkable
class Backend(SceneRenderer, Protocol):
    """See mrbokeh.scene.base."""
