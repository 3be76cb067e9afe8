"""The renderer of the package, under the name that the diagrams know."""

from falsework.viewer.render import Camera as Camera
from falsework.viewer.render import Solid as Solid
from falsework.viewer.render import render as render
