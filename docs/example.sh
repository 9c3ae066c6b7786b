#!/bin/sh
# The README's worked diagnosis, and its pictures where Chromium is installed. Writes into a folder:
#     docs/example.sh FOLDER
set -eu
docs=$(cd "$(dirname "$0")" && pwd)
mkdir -p "$1" && cd "$1"

cangauge twin --pack leaf40 --seed 4 --discharge -o full.csv >/dev/null
for day in 1 2 3; do
    cangauge twin --pack leaf40 --seed 4 --day $day --hours 1 -o good$day.csv >/dev/null
done
cangauge twin --pack leaf40 --seed 4 --day 9 --hours 1 --effect resistance_step:step_ohm=0.04 -o today.csv >/dev/null
cangauge fit full.csv good1.csv good2.csv good3.csv -o pack.json --report fit.html >/dev/null
cangauge estimate today.csv -m pack.json -o soc.csv --report estimate.html >/dev/null
cangauge gap today.csv -m pack.json --reference good1.csv --reference good2.csv --reference good3.csv \
    --extended better.json --report gap.html

browser=$(command -v chromium || command -v chromium-browser || command -v google-chrome || true)
if [ -n "$browser" ]; then
    for page in fit estimate gap; do
        "$browser" --headless --no-sandbox --hide-scrollbars --virtual-time-budget=8000 \
            --window-size=1000,1250 --screenshot="$docs/page-$page.png" "file://$PWD/$page.html" 2>/dev/null
    done
fi
