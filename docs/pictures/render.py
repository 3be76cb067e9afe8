"""The renderer of the package, under the name that the diagrams know."""

from falsework.viewer import Camera as Camera
from falsework.viewer.pictures.render import ColoredSolid as ColoredSolid
from falsework.viewer.pictures.render import render as render
