"""Scenes in WebDataset shards: tar files of views, with an index that finds each view at once."""
