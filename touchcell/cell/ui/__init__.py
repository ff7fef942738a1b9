"""The operator's page: a run in a browser, live or recorded, and the buttons that stop, reset and resume it."""
