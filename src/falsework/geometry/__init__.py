"""Meshes in, numbers out: masses, contacts, clearance. Knows nothing of stability."""

from falsework.geometry.contact import Contacts, ContactSettings, find_contacts
from falsework.geometry.mesh import MassProperties, TriangleMesh, mass_properties

__all__ = [
    "ContactSettings",
    "Contacts",
    "MassProperties",
    "TriangleMesh",
    "find_contacts",
    "mass_properties",
]
