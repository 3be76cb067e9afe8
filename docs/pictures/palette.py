"""Colours of the diagrams, those of the package where it has them."""

from falsework.viewer.palette import BOUNDARY as BOUNDARY
from falsework.viewer.palette import INK as INK
from falsework.viewer.palette import INSTALLED as SAND  # noqa: F401
from falsework.viewer.palette import ROBOTS as ROBOTS

FORCE = "#d55e00"
GRAVITY = "#22252a"
