"""Films of a memory: a path of cameras, what each frame shows, and the file."""
