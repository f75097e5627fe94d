"""A bank of worlds: what a world integrates, and how worlds move on."""
