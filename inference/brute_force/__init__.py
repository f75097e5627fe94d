"""What beliefs must be, computed without any engine."""
