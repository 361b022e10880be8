"""From decoded joints to commands: contact rules, IK, smoothing, stiffness, and the safety filter at the end."""
