"""The mathematical model: nodes, their motion, interactions, edge rules, sensors, landmarks; plain NumPy."""
