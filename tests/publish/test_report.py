"""The report says what run.json says, whatever names and reasons hold."""

from kibs_steps import store
from kibs_steps.publish import report

RUN = {
    "written": "2026-01-01",
    "licence": "CC0",
    "scene": {
        "name": "a<b",
        "grid": {"width": 100, "height": 50, "gsd": 0.4},
        "view": {"azimuth": 181.1, "elevation": 59.3},
        "position_corrected": True,
    },
    "results": {
        "sections": {"count": 3, "status": {"ok": 2, "too_small": 1}, "reasons": {"# px is too small": 1}},
        "buildings": {"count": 1, "lod": {"2.0": 1}, "roof_type": {"gable": 1}, "reasons": {}},
    },
    "times": {"solids": {"seconds": 1.25, "jobs": 2, "peak_mb": 120.0}},
    "inputs": [
        {"file": "a.tif", "sha256": "ab12"},
        {"file": "https://x.org/b.tif", "version": [None, "Mon, 1 Jan", "7"]},
    ],
    "models": [],
    "versions": {"numpy": "2.0"},
}


def test_everything_is_told_and_nothing_is_markup():
    failed = {"r000c001": {"status": "failed", "reason": "solids: <script>alert(1)</script>"}}
    evaluation = {"pixels": {"all": {"iou": 0.8125}}, "heights": {"found": {"all": {"mae": None}}}}
    text = report.page({**RUN, "failed_blocks": failed}, evaluation, {"Roofs": b"png"})
    for told in (
        "a&lt;b",
        "100 x 50 px of 0.4 m",
        "3 roof sections by status",
        "too_small",
        "0.812",
        "1.2 s in 2 jobs",
        "ab12",
        "Mon, 1 Jan, 7",
    ):
        assert told in text, told
    assert "made without the blocks" in text
    assert "data:image/png;base64,cG5n" in text
    assert "<script" not in text


def test_a_comparison_of_before_is_not_shown(tmp_path):
    """Without truth the picture of an earlier run says nothing of this one."""
    store.write_json(tmp_path / "run.json", RUN)
    (tmp_path / "evaluation.png").write_bytes(b"png")
    store.write_json(tmp_path / "evaluation.json", {"pixels": {"all": {"iou": 0.5}}, "heights": {"found": {"all": {}}}})
    for more, shown in (([], False), ([f"--evaluation={tmp_path / 'evaluation.json'}"], True)):
        report.main([f"--run={tmp_path / 'run.json'}", f"--out={tmp_path / 'report.html'}", *more])
        assert ("Comparison with the truth" in (tmp_path / "report.html").read_text()) == shown


def test_a_scene_without_failures_and_truth():
    text = report.page(RUN, None, {})
    assert "failed" not in text
    assert "truth" not in text


def test_from_where_a_scene_is_seen():
    def told(**scene):
        return report.page({**RUN, "scene": {**RUN["scene"], **scene}}, None, {})

    assert "azimuth 181.1°, elevation 59.3°" in told()
    assert '<td class="n">unknown</td>' in told(view=None)
    both = told(regions=[{}, {}], position_corrected=False)
    assert "elevation 59.3° and 2 regions with views of their own" in both
    assert 'where they stand</td><td class="n">no<' in both
    assert "5.00 km²" in told(grid={"width": 5000, "height": 4000, "gsd": 0.5})
