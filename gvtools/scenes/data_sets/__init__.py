"""Public data sets by name: what is known of each (``data_specs/data_sets``), and its reader."""
