"""One suite of checks for every driver; ``docs/how-to/write-a-driver.md`` explains how to certify one."""
