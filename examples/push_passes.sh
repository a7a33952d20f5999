#!/bin/sh
# Send every pass in a folder to magcal; for cron or the pass scheduler.
#
#   push_passes.sh FOLDER SATELLITE MAGNETOMETER
#
# MAGCAL_URL and MAGCAL_KEY come from the environment. Receivers write FOLDER/x.part and rename it to FOLDER/x.csv when
# it is whole. A pass is moved to FOLDER/sent only after the service has acknowledged it, and to FOLDER/refused where
# the service will never take it (its faults are in x.csv.why). What the network or the service could not do now stays
# and is sent at the next run. Sending twice does no harm: the same bytes are the same session.
set -eu
folder=$1 satellite=$2 magnetometer=$3
mkdir -p "$folder/sent" "$folder/refused"
exec 9>"$folder/.lock"
if command -v flock >/dev/null && ! flock -n 9; then exit 0; fi

status=0
for pass in "$folder"/*.csv "$folder"/*.csv.gz "$folder"/*.parquet; do
  [ -f "$pass" ] || continue
  name=$(basename "$pass")
  if why=$(magcal push "$pass" --satellite "$satellite" --magnetometer "$magnetometer" 2>&1); then
    mv "$pass" "$folder/sent/$name"
    continue
  fi
  case $why in
    *unreachable*|*unavailable*|*busy*|*unauthorized*|*quota*|*in_progress*|*storage_full*|*not_found*|*scope_required*)
      echo "$name: kept for the next run: $why" >&2; status=1 ;;
    *)
      mv "$pass" "$folder/refused/$name"; printf '%s\n' "$why" > "$folder/refused/$name.why"
      echo "$name: refused: $why" >&2; status=1 ;;
  esac
done
exit $status
