"""Light scattered in a round atmosphere of molecules, aerosol and ozone, any number of times, as tables."""
