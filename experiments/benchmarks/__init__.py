"""Timings; no test depends on one."""
