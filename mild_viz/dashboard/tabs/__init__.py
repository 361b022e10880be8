"""The tabs of the control panel: each builds its widgets, reads them back validated, and follows the rollout."""
