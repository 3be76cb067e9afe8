from falsework.viewer.cells.cell_page import view_cell as view_cell
from falsework.viewer.cells.cell_picture import picture_cell as picture_cell
from falsework.viewer.pictures.render import Camera as Camera
from falsework.viewer.timeline import Timeline as Timeline
