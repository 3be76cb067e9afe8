from falsework.viewer.pictures.render import Camera as Camera
from falsework.viewer.proof import StateProof as StateProof
from falsework.viewer.show import animate as animate
from falsework.viewer.show import picture as picture
from falsework.viewer.show import view as view
from falsework.viewer.timeline import Timeline as Timeline
from falsework.viewer.viewable import Viewable as Viewable
from falsework.viewer.viewable import open_file as open_file
