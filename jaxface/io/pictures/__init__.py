"""Drawings, sheets, charts and the report."""
