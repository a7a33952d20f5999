"""Metrics of each magnetometer: for a key that reaches it alone, bounded, and what the alert rules ask for is there."""

import re
from pathlib import Path

import httpx2
import yaml

ROOT = Path(__file__).resolve().parents[3]
OWN = re.compile(r"magcal_\w+")


def metrics(service, key: str = "") -> str:
    headers = {"Authorization": f"Bearer {key}"} if key else {}
    answer = httpx2.get(f"{service.url}/metrics", headers=headers, trust_env=False, timeout=60)
    assert answer.status_code == 200
    return answer.text


def test_a_key_is_told_of_its_own_magnetometers_and_nobody_of_any(service, api, satellite, names):
    other = next(names)
    api.post("/satellites", json={"id": other}).raise_for_status()
    api.post(f"/satellites/{other}/magnetometers", json={"id": "mgm", "unit": "nT"}).raise_for_status()
    told = metrics(service, service.key("read", satellites=[satellite]))
    assert f'magcal_magnetometer_verdict{{magnetometer="mgm",satellite="{satellite}"}} -1.0' in told
    assert f'code="no_active_set",magnetometer="mgm",satellite="{satellite}",severity="watch"}} 1.0' in told
    assert f'"{other}"' not in told
    for without in (metrics(service), metrics(service, service.key("ingest"))):
        assert "satellite=" not in without
        assert "magcal_jobs" in without
    wrong = httpx2.get(f"{service.url}/metrics", headers={"Authorization": "Bearer mgc_x"}, trust_env=False)
    assert wrong.status_code == 401


def test_they_are_bounded_in_number(new_service):
    service = new_service(metrics_magnetometers=2)
    with service.client() as api:
        for number in range(3):
            api.post("/satellites", json={"id": f"sat-{number}"}).raise_for_status()
            path = f"/satellites/sat-{number}/magnetometers"
            api.post(path, json={"id": "mgm", "unit": "nT"}).raise_for_status()
    told = metrics(service, service.admin_key)
    assert len(re.findall(r"^magcal_magnetometer_verdict\{", told, re.MULTILINE)) == 2
    assert "magcal_magnetometers 3.0" in told
    assert "magcal_magnetometers_left_out 1.0" in told


def test_the_alert_rules_ask_for_metrics_and_codes_that_there_are(service, satellite):
    from app.attention.causes.registry import CAUSES

    told = metrics(service, service.admin_key)
    there = set(re.findall(r"^# TYPE (\w+)", told, re.MULTILINE))
    rules = yaml.safe_load((ROOT / "examples" / "prometheus-alerts.yml").read_text())
    alerts = [rule for group in rules["groups"] for rule in group["rules"]]
    assert len({alert["alert"] for alert in alerts}) == len(alerts) > 5
    for alert in alerts:
        assert set(OWN.findall(alert["expr"])) <= there, alert["alert"]
        for named in re.findall(r'code=~?"([^"]+)"', alert["expr"]):
            assert set(named.split("|")) <= set(CAUSES), alert["alert"]
