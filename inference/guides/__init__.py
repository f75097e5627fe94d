"""What stands for a posterior in variational inference."""
