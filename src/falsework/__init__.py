"""Assembly planning for rigid-block structures, with robots as temporary supports and certified stability."""

from falsework._version import __version__ as __version__
from falsework.assembly.load import register_reader as _register_reader
from falsework.utils.display.frame import register_painter as _register_painter
from falsework.utils.display.notebook import register_display as _register_display
from falsework.utils.lazy import lazy_exports as _lazy_exports

__getattr__, __dir__, __all__ = _lazy_exports(__name__)

# Formats of other programs; they are read by a package that `assembly` must not know.
_FORMATS = (("bricks", "bricks"), ("compas_read", "compas"), ("rhino_read", "rhino"), ("step_read", "step"))
for _module, _format in _FORMATS:
    _place = f"falsework.interop.{_module}"
    _register_reader(f"{_place}:is_{_format}", f"{_place}:load_{_format}", f"{_place}:read_{_format}")
# Pictures are drawn by a package that those of the objects must not know.
_register_display("falsework.viewer.notebook:html_of")
_register_painter("falsework.viewer.pictures.frame:state_frame")
