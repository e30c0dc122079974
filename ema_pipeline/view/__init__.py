"""The live page: the report over a results folder, with effects to add and remove in the browser.

`server` answers the browser, `guard` lets nobody else in, `session` holds what is shown and what is under way,
`worker` refits in a process of its own, `snapshots` keeps earlier states of the folder for undo and cancel.
"""
