"""What an agent sees and does: kinds of observations and actions, and their checks."""
