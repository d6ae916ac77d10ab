-- PostgreSQL 15 or later, with TimescaleDB where it is there: psql -d beltgauge -f timescaledb.sql
-- Whatever is inserted into beltgauge.inbox as JSON goes to its table; what comes twice replaces itself.
BEGIN;
CREATE SCHEMA IF NOT EXISTS beltgauge;
SET LOCAL search_path TO beltgauge, public;

CREATE TABLE IF NOT EXISTS parcel (
    -- The same for the same parcel, however often it is told.
    id text NOT NULL,
    -- When the machine told its PLC, by its own clock: it belongs to the id.
    utc timestamptz NOT NULL,
    site text NOT NULL,
    lane text NOT NULL,
    serial text NOT NULL,
    boots integer NOT NULL,
    seq bigint NOT NULL,
    may_be_used boolean NOT NULL,
    length_mm double precision NOT NULL,
    width_mm double precision NOT NULL,
    height_mm double precision NOT NULL,
    sigma_length_mm double precision NOT NULL,
    sigma_width_mm double precision NOT NULL,
    sigma_height_mm double precision NOT NULL,
    yaw_deg double precision NOT NULL,
    x_mm double precision NOT NULL,
    y_mm double precision NOT NULL,
    shape text NOT NULL,
    flags text[] NOT NULL,
    not_measured text,
    belt_speed_mm_per_s double precision NOT NULL,
    belt_travel_mm double precision NOT NULL,
    by_encoder boolean NOT NULL,
    version text NOT NULL,
    -- The whole message: what later versions add is in it.
    message jsonb NOT NULL,
    PRIMARY KEY (id, utc)
);
CREATE TABLE IF NOT EXISTS event (
    id text NOT NULL,
    utc timestamptz NOT NULL,
    site text NOT NULL,
    lane text NOT NULL,
    kind text NOT NULL,
    code bigint NOT NULL,
    detail text NOT NULL,
    PRIMARY KEY (id, utc)
);
CREATE TABLE IF NOT EXISTS health (
    serial text NOT NULL,
    utc timestamptz NOT NULL,
    site text NOT NULL,
    lane text NOT NULL,
    figures jsonb NOT NULL,
    PRIMARY KEY (serial, utc)
);
CREATE TABLE IF NOT EXISTS state (
    site text NOT NULL,
    lane text NOT NULL,
    state text NOT NULL,
    since timestamptz NOT NULL,
    message jsonb NOT NULL,
    PRIMARY KEY (site, lane)
);
CREATE TABLE IF NOT EXISTS refused (
    at timestamptz NOT NULL DEFAULT now(),
    why text NOT NULL,
    value text NOT NULL
);

DO $$
BEGIN
    IF EXISTS (SELECT FROM pg_available_extensions WHERE name = 'timescaledb') THEN
        CREATE EXTENSION IF NOT EXISTS timescaledb;
        PERFORM create_hypertable('parcel', 'utc', if_not_exists => true);
        PERFORM create_hypertable('event', 'utc', if_not_exists => true);
        PERFORM create_hypertable('health', 'utc', if_not_exists => true);
        PERFORM add_retention_policy('health', INTERVAL '90 days', if_not_exists => true);
    END IF;
END $$;
CREATE INDEX IF NOT EXISTS parcel_by_number ON parcel (serial, seq);
CREATE INDEX IF NOT EXISTS parcel_by_lane ON parcel (site, lane, utc DESC);

-- Nothing stays in it.
CREATE TABLE IF NOT EXISTS inbox (time timestamptz DEFAULT now(), value text NOT NULL);

CREATE OR REPLACE FUNCTION take() RETURNS trigger LANGUAGE plpgsql SET search_path = beltgauge, public AS $$
DECLARE
    m jsonb;
BEGIN
    m := NEW.value::jsonb;
    IF (m->>'schema')::int IS DISTINCT FROM 1 THEN
        RAISE EXCEPTION 'schema %', m->>'schema';
    END IF;
    IF m ? 'seq' THEN
        INSERT INTO parcel
        SELECT m->>'id', (m->>'utc')::timestamptz, m->>'site', m->>'lane', m->>'serial',
            (m->>'boots')::int, (m->>'seq')::bigint, (m->>'may_be_used')::boolean,
            (m->>'length_mm')::float8, (m->>'width_mm')::float8, (m->>'height_mm')::float8,
            (m->>'sigma_length_mm')::float8, (m->>'sigma_width_mm')::float8, (m->>'sigma_height_mm')::float8,
            (m->>'yaw_deg')::float8, (m->>'x_mm')::float8, (m->>'y_mm')::float8, m->>'shape',
            ARRAY(SELECT jsonb_array_elements_text(m->'flags')), m->>'not_measured',
            (m->>'belt_speed_mm_per_s')::float8, (m->>'belt_travel_mm')::float8, (m->>'by_encoder')::boolean,
            m->>'version', m - 'replay'
        ON CONFLICT (id, utc) DO UPDATE SET site = excluded.site, lane = excluded.lane, message = excluded.message;
    ELSIF m ? 'kind' THEN
        INSERT INTO event
        SELECT m->>'id', (m->>'utc')::timestamptz, m->>'site', m->>'lane', m->>'kind', (m->>'code')::bigint,
            m->>'detail'
        ON CONFLICT (id, utc) DO NOTHING;
    ELSIF m ? 'state' THEN
        -- A will does not know when.
        INSERT INTO state
        SELECT m->>'site', m->>'lane', m->>'state', coalesce((m->>'since')::timestamptz, now()), m
        ON CONFLICT (site, lane) DO UPDATE
            SET state = excluded.state, since = excluded.since, message = excluded.message;
    ELSIF m ? 'uptime_s' THEN
        INSERT INTO health
        SELECT m->>'serial', (m->>'utc')::timestamptz, m->>'site', m->>'lane', m
        ON CONFLICT (serial, utc) DO NOTHING;
    ELSE
        RAISE EXCEPTION 'unknown message';
    END IF;
    RETURN NULL;
EXCEPTION WHEN OTHERS THEN
    -- One that is broken does not hold up those behind it.
    INSERT INTO refused (why, value) VALUES (SQLERRM, left(NEW.value, 4096));
    RETURN NULL;
END $$;

DROP TRIGGER IF EXISTS take ON inbox;
CREATE TRIGGER take BEFORE INSERT ON inbox FOR EACH ROW EXECUTE FUNCTION take();

-- Numbers that are missing, for `cmd/replay`: of every machine, the gaps between those that are there.
CREATE OR REPLACE VIEW missing AS
SELECT site, lane, serial, seq + 1 AS "from", next_seq - 1 AS "to"
FROM (
    SELECT site, lane, serial, seq, lead(seq) OVER (PARTITION BY serial ORDER BY seq) AS next_seq FROM parcel
) AS numbered
WHERE next_seq > seq + 1;
COMMIT;
