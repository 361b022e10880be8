"""Training: the human-human stage (Algorithm 1) and the robot stage (Algorithm 2)."""
