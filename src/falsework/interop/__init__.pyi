from falsework.interop import compas_dem as compas_dem
from falsework.interop.bricks import Brick as Brick
from falsework.interop.bricks import assemble_bricks as assemble_bricks
from falsework.interop.compas_write import to_compas as to_compas
