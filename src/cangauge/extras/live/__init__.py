"""What a running service offers over networks, in a process of its own that is fed through a pipe.

`launch` starts and watches the process, `serve` is it. `http` serves status and metrics, `server`
the live page, whose rows `history` keeps and whose figures `charts` describes. `mqtt` publishes.
"""
