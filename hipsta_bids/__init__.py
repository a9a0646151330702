"""Hippocampal thickness, curvature and shape maps from subfield segmentations.

``import hipsta_bids as hb`` gives :func:`measure`, :func:`load`, :func:`register`, :func:`group`,
:func:`correlate`, :func:`figure`, :func:`example`, and the functions ``plot_sheet``,
``plot_surface`` and ``plot_group``. They are loaded when first used.
"""

__version__ = "1.0.0"

#: The Python interface, by the module that has it.
_MODULES = {
    "measure": "hipsta_bids.api.maps",
    "load": "hipsta_bids.api.datasets",
    "example": "hipsta_bids.api.datasets",
    "register": "hipsta_bids.api.models",
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
    from hipsta_bids.api.models import group, register
    from hipsta_bids.api.plots import plot_group, plot_sheet, plot_surface
    from hipsta_bids.extensions.agreement.correlate import correlate
else:

    def __getattr__(name: str) -> object:
        from importlib import import_module  # noqa: PLC0415  (the package itself loads nothing)

        if name == "group":  # the folder of that name is called as a function
            return import_module("hipsta_bids.group")
        module = _MODULES.get(name)
        if module is None and name in __all__:
            from hipsta_bids.joints import find_functions  # noqa: PLC0415  (as above)

            module = find_functions().get(name)
        if module is None:
            deleted = " (its extension was deleted)" if name in __all__ else ""
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}{deleted}")
        value = globals()[name] = getattr(import_module(module), name)
        return value

    def __dir__() -> list[str]:
        return sorted({*globals(), *__all__})


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
