"""What a screen can do and how to drive it: inverse drives, maps of friction, folds of the mobile law."""
