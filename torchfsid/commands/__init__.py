"""The commands of the command line.

For any command: `command_line` (exit codes, one line per mistake), `interruption` (signals), `results_folder` (one
owner, whole files), `terminal` (tables, progress). For logs: `on_logs` runs both commands. `observe`, `hypotheses` and
`check` compute, `results`, `figures` and `report` write and print.
"""
