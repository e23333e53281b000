"""The mathematical model: nodes, their motion, interactions, edge rules, landmarks; plain NumPy."""
