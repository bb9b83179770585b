"""Do the dashboard and the alerts ask for what the server has?

queries.py METRICS RULES_OUT: METRICS is a page of a running server. Writes the dashboard's queries as recording rules
to RULES_OUT, so that promtool can check their syntax.
"""

import json
import re
import sys
from pathlib import Path

import yaml

DEPLOY = Path(__file__).resolve().parents[1]
DASHBOARD = DEPLOY / "grafana/dashboards/fnsf.json"
SOURCES = DEPLOY / "grafana/provisioning/datasources/prometheus.yaml"
RULES = DEPLOY / "prometheus/rules/fnsf.yml"
# What Grafana fills in, as Prometheus would get it.
FILLED_IN = {"$__rate_interval": "1m", "$instance": ".*"}
# Labels that Prometheus adds when it scrapes.
SCRAPED = {"instance", "job"}
SELECTOR = re.compile(r"\b((?:fnsf|process)_\w+)\s*(?:\{([^}]*)\})?")
MATCHER = re.compile(r'(\w+)\s*(=~|!=|!~|=)\s*"([^"]*)"')


def series_of(page):
    """Every sample's name, with the values that each of its labels has."""
    series = {}
    for line in page.splitlines():
        if line and not line.startswith("#"):
            name, labels = re.match(r"(\w+)(?:\{(.*)\})? ", line).groups()
            known = series.setdefault(name, {})
            for label, value in re.findall(r'(\w+)="([^"]*)"', labels or ""):
                known.setdefault(label, set()).add(value)
    return series


def faults_of(query, series):
    """What a query asks for that no series has."""
    for name, matchers in SELECTOR.findall(query):
        if name not in series:
            yield f"no series is called {name}"
            continue
        for label, operator, value in MATCHER.findall(matchers):
            if label in SCRAPED:
                continue
            asked = value.split("|") if "~" in operator else [value]
            has = series[name].get(label, set())
            yield from (f'{name} has no {label}="{one}", only {sorted(has)}' for one in asked if one not in has)


def dashboard_queries(dashboard):
    for panel in dashboard["panels"]:
        for target in panel.get("targets", []):
            yield f"panel {panel['title']!r}", target["expr"]
    for note in dashboard["annotations"]["list"]:
        yield f"annotation {note['name']!r}", note["expr"]
    for variable in dashboard["templating"]["list"]:
        metric = re.fullmatch(r"label_values\((\w+), \w+\)", variable["definition"])
        yield f"variable {variable['name']!r}", metric.group(1)


def dashboard_faults(dashboard):
    """What Grafana would show wrong without saying so."""
    source = yaml.safe_load(SOURCES.read_text())["datasources"][0]["uid"]
    panels = dashboard["panels"]
    if len({panel["id"] for panel in panels}) != len(panels):
        yield "two panels have the same id"
    taken = {}
    for panel in panels:
        place = panel["gridPos"]
        for x in range(place["x"], place["x"] + place["w"]):
            for y in range(place["y"], place["y"] + place["h"]):
                if x >= 24 or (x, y) in taken:
                    yield f"{panel['title']!r} lies over {taken.get((x, y), 'the edge')!r}"
                    break
                taken[x, y] = panel["title"]
        if panel["type"] == "row":
            continue
        if not panel.get("description"):
            yield f"{panel['title']!r} does not say what it shows"
        if any(part["datasource"]["uid"] != source for part in [panel, *panel["targets"]]):
            yield f"{panel['title']!r} asks another data source than {source}"


def main(metrics, rules_out):
    series = series_of(Path(metrics).read_text())
    dashboard = json.loads(DASHBOARD.read_text())
    rules = [rule for group in yaml.safe_load(RULES.read_text())["groups"] for rule in group["rules"]]
    asked = list(dashboard_queries(dashboard))
    faults = [f"dashboard: {fault}" for fault in dashboard_faults(dashboard)]
    for place, query in asked + [(f"alert {rule['alert']}", rule["expr"]) for rule in rules]:
        faults += [f"{place}: {fault}" for fault in faults_of(query, series)]
    recorded = []
    for number, (_, query) in enumerate(asked):
        for variable, value in FILLED_IN.items():
            query = query.replace(variable, value)
        if "$" in query:
            faults.append(f"{asked[number][0]}: a variable that nobody fills in")
        recorded.append({"record": f"dashboard:query{number}", "expr": query})
    Path(rules_out).write_text(yaml.safe_dump({"groups": [{"name": "dashboard", "rules": recorded}]}))
    shown = {name for _, query in asked for name, _ in SELECTOR.findall(query)}
    # Those of the process have Prometheus' standard names, which other dashboards show.
    families = {re.sub(r"_(bucket|sum|count)$", "", name) for name in series if name.startswith("fnsf_")}
    for family in sorted(families - {re.sub(r"_(bucket|sum|count)$", "", name) for name in shown}):
        faults.append(f"dashboard: {family} is shown nowhere")
    for fault in faults:
        print(fault, file=sys.stderr)
    print(f"{len(asked)} queries and {len(rules)} alerts over {len(series)} names, {len(faults)} faults")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
