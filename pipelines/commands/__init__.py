"""The commands of the program ``gvtools``, one module each."""
