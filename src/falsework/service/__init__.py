"""Replanning and verdicts over HTTP, for one structure: bounded in size and time, proven answers or an honest no.

`app` says what there is to ask, `guard` and `server` keep bad requests out, `pool` shares the work among processes that
`worker` runs, and gathers what comes together into batches.
"""
