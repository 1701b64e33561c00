"""A search for the settings of one scenario (``esc-tune``)."""
