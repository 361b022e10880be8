"""How the arm gives way: joint impedance control of a rollout's commands in MuJoCo, a human's hand on the robot's."""
