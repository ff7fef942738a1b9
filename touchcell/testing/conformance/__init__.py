"""One suite of checks for every driver, ours and other people's; ``docs/drivers.md`` says how to certify one."""
