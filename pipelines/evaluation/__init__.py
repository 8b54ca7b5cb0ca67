"""Evaluation of finished runs, and the tables written from it."""
