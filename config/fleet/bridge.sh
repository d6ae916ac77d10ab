#!/bin/bash
# From the broker into PostgreSQL with nothing but the two clients: bridge.sh BROKER [MORE OF mosquitto_sub]
# with PGHOST, PGDATABASE and PGUSER set. Messages go in batches: every second, or every 500.
# What is under way when it is killed is asked for again: the view `missing`.
set -euo pipefail
broker=$1
shift
insert() {
    # JSON is one field: the quote and the delimiter are characters that it cannot hold.
    psql -q -v ON_ERROR_STOP=1 -c "COPY beltgauge.inbox (value) FROM STDIN
        WITH (FORMAT csv, QUOTE E'\x01', DELIMITER E'\x02', ESCAPE E'\x01')"
}
mosquitto_sub -V 5 -h "$broker" -i bridge -c -x 86400 -q 1 "$@" \
    -t 'beltgauge/+/+/parcel' -t 'beltgauge/+/+/event' -t 'beltgauge/+/+/health' -t 'beltgauge/+/+/state' |
    while IFS= read -r line; do
        batch=$line$'\n'
        for _ in {2..500}; do
            # A line may come in parts.
            IFS= read -r -t 1 line || { [ -n "$line" ] || break; IFS= read -r rest || true; line+=$rest; }
            batch+=$line$'\n'
        done
        until printf %s "$batch" | insert; do sleep 5; done
    done
