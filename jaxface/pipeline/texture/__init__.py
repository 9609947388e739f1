"""Fitted face -> partial albedo -> complete albedo -> files."""
