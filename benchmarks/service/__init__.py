"""The live service at work: endurance, hostile clients, round trips."""
