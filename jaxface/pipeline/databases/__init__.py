"""Databases of textures: painted, imported, from photos, from scans."""
