"""The forward model: measurements and bounds on their errors, tasks, barriers, the controller, the closed loop."""
