"""Plug-ins to start one's own from."""
