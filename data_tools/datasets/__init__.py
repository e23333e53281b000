"""Readers and writers of datasets, one package each."""
