"""Estimators behind one protocol, and the textbook reference they must agree with."""
