"""Text for terminals, files and fonts that have ASCII only."""

from autocalib_ros.util.plain_text import in_ascii


def test_signs_get_a_form_in_ascii_and_other_letters_a_question_mark():
    assert in_ascii('90 ± 1°, ö') == '90 +- 1 degrees, ?'
