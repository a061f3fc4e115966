"""Agents and filters for use elsewhere."""
