"""What the command line does.

For any command: `command_line` (exit codes, one line for a mistake), `interruption` (signals), `results_folder` (one
owner, whole files), `terminal` (tables, progress). For logs: `on_logs` runs the two commands; `observe`, `hypotheses`
and `check` find out; `results`, `figures` and `report` tell.
"""
