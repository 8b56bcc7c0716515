"""Deployment files of a fleet: their schemas and guarantees."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import warnings
from pathlib import Path

import pytest
import yaml

from real2sim_server.service.http.telemetry import Metrics
from real2sim_server.settings import OTHER_VARIABLES, Settings

DOCKER = Path(__file__).parents[1] / "docker"
KUBERNETES = DOCKER / "kubernetes"
MANIFESTS = ("workers.yaml", "proxy.yaml", "scaling.yaml")


def manifests() -> list[dict]:
    return [
        document
        for name in MANIFESTS
        for document in yaml.safe_load_all((KUBERNETES / "base" / name).read_text())
    ]


def pods() -> list[dict]:
    return [m["spec"]["template"]["spec"] for m in manifests() if "template" in m["spec"]]


@pytest.fixture(scope="module")
def cluster() -> dict:
    return yaml.safe_load((DOCKER / "compose.cluster.yml").read_text())


# --- schemas ----------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["compose.yml", "compose.gpu.yml", "compose.cluster.yml"])
def test_a_compose_file_is_valid(name):
    jsonschema = pytest.importorskip("jsonschema")
    checker = pytest.importorskip("check_jsonschema", reason="pip install 'real2sim[dev]'")
    folder = Path(checker.__file__).parent / "builtin_schemas" / "vendor"
    schema = json.loads((folder / "compose-spec.json").read_text())
    document = yaml.safe_load((DOCKER / name).read_text())
    jsonschema.Draft7Validator(schema).validate(document)


def test_kubernetes_manifests_are_valid():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        validating = pytest.importorskip(
            "kubernetes_validate", reason="pip install 'real2sim[dev]'"
        )
        version = validating.latest_version()
        for manifest in manifests():
            validating.validate(manifest, version, strict=True)


def test_the_gpu_overlay_applies_to_the_base():
    overlay = yaml.safe_load((KUBERNETES / "gpu" / "kustomization.yaml").read_text())
    (patch,) = overlay["patches"]
    (worker,) = (
        m
        for m in manifests()
        if m["metadata"]["name"] == patch["target"]["name"] and m["kind"] == patch["target"]["kind"]
    )
    for step in yaml.safe_load(patch["patch"]):
        above = worker
        for part in step["path"].strip("/").split("/")[:-1]:
            above = above[int(part)] if isinstance(above, list) else above[part]
        last = step["path"].rpartition("/")[2].replace("~1", "/")
        assert step["op"] == "add"
        assert last not in above
        above[last] = step["value"]
    (container,) = worker["spec"]["template"]["spec"]["containers"]
    assert container["resources"]["limits"]["nvidia.com/gpu"] == 1


def test_kustomizations_name_existing_files():
    for folder in (KUBERNETES, KUBERNETES / "base", KUBERNETES / "gpu"):
        kustomization = yaml.safe_load((folder / "kustomization.yaml").read_text())
        files = [f for g in kustomization.get("configMapGenerator", ()) for f in g["files"]]
        assert all((folder / name).exists() for name in [*kustomization["resources"], *files])


@pytest.mark.parametrize("folder", [KUBERNETES, KUBERNETES / "gpu"], ids=["cpu", "gpu"])
def test_kustomize_builds_valid_manifests(folder):
    kubectl = shutil.which("kubectl")
    if kubectl is None:
        pytest.skip("there is no kubectl")
    built = subprocess.run(
        [kubectl, "kustomize", str(folder)], capture_output=True, text=True, check=False
    )
    assert built.returncode == 0, built.stderr
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        validating = pytest.importorskip(
            "kubernetes_validate", reason="pip install 'real2sim[dev]'"
        )
        found = list(yaml.safe_load_all(built.stdout))
        for manifest in found:
            validating.validate(manifest, validating.latest_version(), strict=True)
    kinds = {manifest["kind"] for manifest in found}
    assert {"StatefulSet", "Deployment", "ConfigMap", "PodDisruptionBudget"} <= kinds
    assert {manifest["metadata"]["namespace"] for manifest in found} == {"real2sim"}


def test_an_overlay_is_not_inside_its_base():
    """kustomize refuses a base folder that contains the overlay."""
    for folder in (KUBERNETES, KUBERNETES / "gpu"):
        kustomization = yaml.safe_load((folder / "kustomization.yaml").read_text())
        for name in kustomization["resources"]:
            assert not folder.resolve().is_relative_to((folder / name).resolve())


# --- guarantees -------------------------------------------------------------------------


def test_containers_are_unprivileged_with_read_only_roots(cluster):
    for name, service in cluster["services"].items():
        assert service["read_only"] is True, name
        assert service["cap_drop"] == ["ALL"], name
        assert "no-new-privileges:true" in service["security_opt"], name
        assert service["mem_limit"], name
    for pod in pods():
        assert pod["securityContext"]["runAsNonRoot"] is True
        assert pod["automountServiceAccountToken"] is False
        for container in [*pod["containers"], *pod.get("initContainers", ())]:
            restricted = container["securityContext"]
            assert restricted["readOnlyRootFilesystem"] is True
            assert restricted["allowPrivilegeEscalation"] is False
            assert restricted["capabilities"] == {"drop": ["ALL"]}
            assert container["resources"]["limits"]["memory"]


def test_only_the_proxy_is_exposed_and_uses_tls(cluster):
    published = {n: s["ports"] for n, s in cluster["services"].items() if "ports" in s}
    assert set(published) == {"proxy", "grafana"}
    assert published["proxy"] == ["${REAL2SIM_ADDRESS:-127.0.0.1}:8443:8443"]
    assert published["grafana"] == ["127.0.0.1:3000:3000"]
    assert "bind :8443 ssl" in (DOCKER / "haproxy.cfg").read_text()


def test_workers_differ_only_in_names_and_folders(cluster):
    workers = {n: s for n, s in cluster["services"].items() if n.startswith("worker")}
    names = {s["environment"]["REAL2SIM_WORKER_ID"] for s in workers.values()}
    assert names == {"w0", "w1", "w2"}
    folders = [v for s in workers.values() for v in s["volumes"] if not v.startswith("objects:")]
    assert len(set(folders)) == len(folders)
    for name, service in workers.items():
        assert f"server w{name[-1]} {name}:8600" in (DOCKER / "haproxy.cfg").read_text()
        drained = 5 + 1.5 + 10
        assert int(service["stop_grace_period"].rstrip("s")) > drained


def test_all_used_settings_exist(cluster):
    given = {v for s in cluster["services"].values() for v in s.get("environment", {})}
    given |= {
        e["name"]
        for pod in pods()
        for c in [*pod["containers"], *pod.get("initContainers", ())]
        for e in c.get("env", ())
    }
    known = {f"REAL2SIM_{name.upper()}" for name in Settings.model_fields} | OTHER_VARIABLES
    known |= {"REAL2SIM_TLS_CERTIFICATE"}
    assert {name for name in given if name.startswith("REAL2SIM_")} <= known


def test_the_kubernetes_proxy_has_the_same_rules_as_the_compose_proxy():
    def rules(path: Path) -> list[str]:
        text = path.read_text()
        lines = text[text.index("global\n") :].splitlines()
        return [line for line in lines if not line.startswith("  server ")]

    assert rules(KUBERNETES / "base" / "haproxy.cfg") == rules(DOCKER / "haproxy.cfg")


def test_kubernetes_waits_for_a_worker_to_hand_over():
    (worker,) = (m for m in manifests() if m["kind"] == "StatefulSet")
    pod = worker["spec"]["template"]["spec"]
    assert pod["terminationGracePeriodSeconds"] > 5 + 1.5 + 10
    probes = {k: v["httpGet"]["path"] for k, v in pod["containers"][0].items() if "Probe" in k}
    assert probes == {
        "startupProbe": "/livez",
        "livenessProbe": "/livez",
        "readinessProbe": "/readyz",
    }


def test_dashboard_and_autoscaler_use_existing_metrics():
    names = {
        sample
        for family in Metrics().registry.collect()
        for suffix in ("", "_total", "_bucket", "_count", "_sum")
        for sample in (family.name + suffix,)
    }
    # Token metrics only exist once there are accounts.
    names |= {"real2sim_token_requests_total", "real2sim_token_refusals_total"}
    dashboard = json.loads((DOCKER / "grafana" / "real2sim.json").read_text())
    asked = {
        name
        for panel in dashboard["panels"]
        for target in panel["targets"]
        for name in re.findall(r"real2sim_\w+", target["expr"])
    }
    (scaler,) = (m for m in manifests() if m["kind"] == "HorizontalPodAutoscaler")
    asked |= {metric["pods"]["metric"]["name"] for metric in scaler["spec"]["metrics"]}
    assert len(asked) > 10
    assert asked <= names


def test_the_proxy_configuration_accepts_a_certificate(tmp_path, monkeypatch):
    from .server.service.haproxy import program

    haproxy = program()
    certificate = tmp_path / "tls.pem"
    made = subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "1", "-subj",
         "/CN=localhost", "-keyout", str(certificate), "-out", str(tmp_path / "c.pem")],
        capture_output=True, check=False,
    )  # fmt: skip
    if made.returncode:
        pytest.skip("there is no openssl")
    certificate.write_text(certificate.read_text() + (tmp_path / "c.pem").read_text())
    monkeypatch.setenv("REAL2SIM_TLS_CERTIFICATE", str(certificate))
    for file in (DOCKER / "haproxy.cfg", KUBERNETES / "base" / "haproxy.cfg"):
        done = subprocess.run([haproxy, "-c", "-f", file], capture_output=True, check=False)
        assert done.returncode == 0, done.stderr
