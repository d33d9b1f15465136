import pytest

from skillweave.errors import RunError
from skillweave.runs.jsonl import JsonLines


def test_lines_that_cannot_be_written_name_the_file_and_what_to_do(tmp_path):
    (tmp_path / "lineage.jsonl").mkdir()
    with pytest.raises(RunError, match=r"could not write .*lineage\.jsonl.*free space"):
        JsonLines(tmp_path / "lineage.jsonl").append([{"a": 1}])


def test_a_half_written_line_is_left_out_and_a_damaged_one_is_named(tmp_path):
    lines = JsonLines(tmp_path / "x.jsonl")
    lines.append([{"a": 1}, {"a": 2}])
    size = lines.size
    lines.close()
    with lines.path.open("a") as file:
        file.write('{"a"')
    assert list(lines.read()) == [{"a": 1}, {"a": 2}]
    lines.rewind(size)
    lines.append([{"a": 3}])
    lines.close()
    assert [line["a"] for line in lines.read()] == [1, 2, 3]
    lines.path.write_text('{"a": 1}\n{"a"\n')
    with pytest.raises(RunError, match="damaged in line 2"):
        list(lines.read())
    lines.path.write_text('{"a": 1}\n{"a": 1}\n{"a": "\\ud800"}\n')
    with pytest.raises(RunError, match=r"damaged in line 3: .* half of a character"):
        list(lines.read())
