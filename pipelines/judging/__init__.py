"""Pictures that any method made, judged with the figures of gvtools' own."""
