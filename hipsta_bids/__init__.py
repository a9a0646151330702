"""Hippocampal thickness, curvature and shape maps from subfield segmentations.

``import hipsta_bids as hb`` gives :func:`measure`, :func:`load`, :func:`register`, :func:`group`,
:func:`correlate`, :func:`figure`, :func:`example`, and the functions ``plot_sheet``,
``plot_surface`` and ``plot_group``. They are loaded when first used.
"""

__version__ = "0.1.0"

#: The Python interface, by the module that has it.
_MODULES = {
    "measure": "hipsta_bids.api.maps",
    "load": "hipsta_bids.api.datasets",
    "example": "hipsta_bids.api.datasets",
    "correlate": "hipsta_bids.group.questions.correlate",
    "register": "hipsta_bids.group.questions.models",
    "figure": "hipsta_bids.api.figures",
    "plot_sheet": "hipsta_bids.api.plots",
    "plot_surface": "hipsta_bids.api.plots",
    "plot_group": "hipsta_bids.api.plots",
}

TYPE_CHECKING = False
if TYPE_CHECKING:
    from hipsta_bids.api.datasets import example, load
    from hipsta_bids.api.figures import figure
    from hipsta_bids.api.maps import measure
    from hipsta_bids.api.plots import plot_group, plot_sheet, plot_surface
    from hipsta_bids.group.questions.correlate import correlate
    from hipsta_bids.group.questions.models import group, register
else:

    def __getattr__(name: str) -> object:
        from importlib import import_module  # noqa: PLC0415  (the package itself loads nothing)

        if name == "group":  # the folder of that name is called as a function
            return import_module("hipsta_bids.group")
        if name not in _MODULES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        value = globals()[name] = getattr(import_module(_MODULES[name]), name)
        return value

    def __dir__() -> list[str]:
        return sorted({*globals(), *_MODULES, "group"})


__all__ = [
    "correlate",
    "example",
    "figure",
    "group",
    "load",
    "measure",
    "plot_group",
    "plot_sheet",
    "plot_surface",
    "register",
]
