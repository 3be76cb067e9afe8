from falsework.geometry.contact.interfaces import Contacts as Contacts
from falsework.geometry.contact.interfaces import ContactSettings as ContactSettings
from falsework.geometry.contact.interfaces import find_contacts as find_contacts
from falsework.geometry.mesh.mesh import TriangleMesh as TriangleMesh
from falsework.geometry.mesh.read import load_meshes as load_meshes
from falsework.geometry.mesh.repair import RepairWarning as RepairWarning
