"""Captures without poses: pictures chosen and checked, cameras found, a project written."""
