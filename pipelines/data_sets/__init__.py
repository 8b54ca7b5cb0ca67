"""Listing, checks, statistics and shards of data sets."""
