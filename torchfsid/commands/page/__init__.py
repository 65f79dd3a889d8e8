"""`torchfsid report`: the page of a results folder, one HTML file that opens offline and asks the network for nothing.

`content` reads the folder into one record, `sets` and `tables` help it, `words` says the verdicts, and `write` puts
the record into the template under `assets`, whose scripts draw it.
"""
