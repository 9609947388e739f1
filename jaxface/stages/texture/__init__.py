"""Textures: what a photo shows, made plausible, mirrored, analysed, synthesised."""
