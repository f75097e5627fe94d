"""The laws of a finite model as tables, on the mesh of all its hidden values."""
