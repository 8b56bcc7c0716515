"""File formats of data sets, read strictly; every failure is a LogError."""
