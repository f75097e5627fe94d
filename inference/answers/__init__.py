"""What is asked of a bank of worlds: marginals, entropies, forecasts, information."""
