"""A table of keys against a set; its rows stay with their keys whenever they are merged."""

import numpy as np

from loam_gtsam.voxels.key_table import KeyTable


def test_a_table_is_a_dictionary_in_the_order_of_its_keys() -> None:
    rng = np.random.default_rng(0)
    table, expected = KeyTable(np.empty(0, np.int64), np.empty((0, 2)), np.empty(0, np.int32)), {}
    waited = 0
    for step in range(200):
        keys = np.unique(rng.integers(-500, 500, rng.integers(0, 12)))
        rows, owners = rng.normal(size=(len(keys), 2)), np.full(len(keys), step, np.int32)
        held = [key in expected for key in keys.tolist()]
        assert table.holds(keys).tolist() == held
        owned = np.full(len(keys), -1)
        table.look_up(keys, 2, owned)
        assert owned.tolist() == [expected.get(key, (-1,))[-1] for key in keys.tolist()]
        added = table.add(keys, rows, owners)
        assert added.tolist() == np.flatnonzero(~np.array(held, np.bool_)).tolist()
        expected |= {int(keys[i]): (*rows[i], step) for i in added}
        assert len(table) == len(expected)
        waited += table.n_waiting > 0
        if step % 50 == 49:
            found, columns, by = table.columns
            assert found.tolist() == sorted(expected)
            assert by.dtype == np.int32
            for key, row, owner in zip(found.tolist(), columns, by, strict=True):
                assert expected[key] == (*row, owner)
    assert 50 < waited < 200


def test_rows_wait_until_they_exceed_a_tenth_of_the_others() -> None:
    table = KeyTable(np.arange(0, 200, 2))
    table.add(np.arange(1, 21, 2))  # ten of a hundred
    assert table.n_waiting == 10
    table.add(np.array([-5]))
    assert table.n_waiting == 0
    assert table.columns[0][:3].tolist() == [-5, 0, 1]


def test_only_one_row_a_key_and_nothing_to_add_changes_nothing() -> None:
    table = KeyTable(np.array([1, 3]), np.array([10.0, 30.0]))
    before = table.columns
    assert table.add(np.array([1, 3]), np.array([11.0, 33.0])).tolist() == []
    assert all(new is old for new, old in zip(table.columns, before, strict=True))
