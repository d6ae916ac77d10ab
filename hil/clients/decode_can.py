"""Decodes frames with cantools by the committed DBC and prints them as JSON.

usage: decode_can.py DBC < lines of ID#HEX
"""
import json
import sys

import cantools

database = cantools.database.load_file(sys.argv[1])
decoded = []
for line in sys.stdin:
    identifier, data = line.strip().split("#")
    message = database.get_message_by_frame_id(int(identifier, 16))
    signals = message.decode(bytes.fromhex(data), decode_choices=False)
    decoded.append({"message": message.name, **signals})
json.dump(decoded, sys.stdout)
