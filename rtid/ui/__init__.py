"""The workbench: a record and its model in the browser, served to this machine alone.

Two processes.  The desk (`desk`, behind `worker`) holds what is heavy, the fits, and does the long
work; the server (`server`, `page`) holds plain arrays and pictures, so that no page ever waits for
a fit.  Everything that a page shows comes from this package: nothing is fetched from other hosts.
"""
