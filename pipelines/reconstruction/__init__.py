"""The rounds of a reconstruction: plan, depth, fuse, project, complete, fuse back."""
