"""Scripts around the trainer: everything that touches files, terminals and processes."""
