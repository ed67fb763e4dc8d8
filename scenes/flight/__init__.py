"""Flight of a sequence: hose, airflow, receiver and dropouts."""
