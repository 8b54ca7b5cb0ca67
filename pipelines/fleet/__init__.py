"""Many scenes: ordinary commands, scene by scene and stage by stage, on one machine or many."""
