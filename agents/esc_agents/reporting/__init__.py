"""Tables, documents, figures, statistics and records of results."""
