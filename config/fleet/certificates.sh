#!/bin/bash
# Certificates for the broker, signed by an authority of the site's own, into the current folder:
#   certificates.sh ADDRESS [NAME]
# ca.crt goes to every machine (fleet.ca_file) and client; ca.key goes nowhere: keep it off the broker.
# broker.crt and broker.key stay at the broker. They hold for ten years and for two; run it again to renew.
set -euo pipefail
address=$1
name=${2:-}
umask 077
[ -e ca.crt ] || openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -days 3650 \
    -keyout ca.key -out ca.crt -subj "/CN=Beltgauge site" -addext "keyUsage=critical,keyCertSign"
openssl req -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes \
    -keyout broker.key -out broker.csr -subj "/CN=broker"
openssl x509 -req -in broker.csr -CA ca.crt -CAkey ca.key -CAcreateserial -days 730 -out broker.crt \
    -extfile <(echo "subjectAltName=IP:$address${name:+,DNS:$name}")
rm broker.csr
