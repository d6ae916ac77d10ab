"""What cantools finds in a DBC, as JSON: kind of bus, and of each message its comment, cycle time and signals' comments.

usage: describe_dbc.py DBC
"""
import json
import sys

import cantools

database = cantools.database.load_file(sys.argv[1])
messages = {
    message.name: {
        "comment": message.comment,
        "cycle_time_ms": message.cycle_time,
        "is_fd": message.is_fd,
        "signals": {signal.name: signal.comment for signal in message.signals},
    }
    for message in database.messages
}
bus = database.dbc.attributes["BusType"].value
nodes = {node.name: node.comment for node in database.nodes}
json.dump({"bus": bus, "nodes": nodes, "messages": messages}, sys.stdout)
