"""Networks that more than one part of the library uses."""
