"""The robot: kinematic chain, retargeting, IK with a joint prior, contact and stiffness."""
