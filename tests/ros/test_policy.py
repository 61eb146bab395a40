"""The policy for SROS 2 gives the nodes what they use, and nothing else."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

from autocalib_ros.node_interface import AUTOCALIB_NODE, GROUND_POINTS_NODE, Endpoint

POLICY = Path(__file__).parents[2] / 'policies' / 'autocalib.policy.xml'
GROUPS = {
    ('topics', 'subscribe'): 'subscribed',
    ('topics', 'publish'): 'published',
    ('services', 'reply'): 'served',
    ('services', 'request'): 'called',
}
PARAMETER_SERVICES = {
    *('~/describe_parameters', '~/get_parameter_types', '~/get_parameters', '~/list_parameters', '~/set_parameters'),
    *('~/set_parameters_atomically', '~/get_type_description'),
}
OF_EVERY_NODE = {'subscribed': {'/clock'}, 'published': {'/rosout', '/parameter_events'}, 'served': PARAMETER_SERVICES}
"""What rclpy itself uses."""
OF_THIS_NODE = {'subscribed': {'/tf_static', 'image/compressed'}}
"""What the interface says in the descriptions of others."""
PICTURES = {'/autocalib/debug_image', '/autocalib/top_view', '/autocalib/image_rect'}


def rights_of(enclave: str) -> dict[str, set[str]]:
    """Return the names that the only profile of an enclave allows, by what is done with them."""
    profiles = ElementTree.parse(POLICY).findall(f'./enclaves/enclave[@path="{enclave}"]/profiles/profile')
    assert len(profiles) == 1
    rights: dict[str, set[str]] = {}
    for group in profiles[0]:
        (action, decision), *others = group.attrib.items()
        assert decision == 'ALLOW' and not others
        names = [one.text for one in group]
        assert len(names) == len(set(names)) and {one.tag for one in group} == {group.tag.removesuffix('s')}
        rights[GROUPS[group.tag, action]] = set(names)
    return rights


def used_by(endpoints: tuple[Endpoint, ...], also: dict[str, set[str]]) -> dict[str, set[str]]:
    used = {
        way: {one.name for one in endpoints if one.direction == way}
        | OF_EVERY_NODE.get(way, set())
        | also.get(way, set())
        for way in GROUPS.values()
    }
    return {way: names for way, names in used.items() if names}


def test_the_node_may_do_what_it_does_and_nothing_else():
    assert rights_of('/autocalib') == used_by(AUTOCALIB_NODE, OF_THIS_NODE)


def test_consumers_read_the_calibration_and_no_pictures():
    rights = rights_of('/autocalib_consumer')
    needed = used_by(GROUND_POINTS_NODE, {})
    assert rights['published'] == needed['published'] and rights['served'] == needed['served']
    assert 'called' not in rights and needed['subscribed'] <= rights['subscribed']
    published = {name.replace('~', '/autocalib') for name in rights_of('/autocalib')['published']}
    assert rights['subscribed'] - needed['subscribed'] <= (published - PICTURES) | {'/tf'}


def test_operators_call_what_the_node_serves():
    rights = rights_of('/autocalib_operator')
    served = {name.replace('~', '/autocalib') for name in rights_of('/autocalib')['served']}
    assert rights['called'] <= served and {'/autocalib/reset', '/autocalib/save'} <= rights['called']


@pytest.mark.dds
def test_a_running_node_uses_what_the_policy_allows(bench):
    """With everything switched on, what DDS shows of the node is what the policy says."""
    node = bench.start(upload_to_driver=True, use_driver_camera_info=True)
    rights = {
        way: {name.replace('~', '/autocalib') if name[0] in '~/' else f'/{name}' for name in names}
        for way, names in rights_of('/autocalib').items()
    }
    shown = {
        'subscribed': node.get_subscriber_names_and_types_by_node('autocalib', '/'),
        'published': node.get_publisher_names_and_types_by_node('autocalib', '/'),
        'served': node.get_service_names_and_types_by_node('autocalib', '/'),
        'called': node.get_client_names_and_types_by_node('autocalib', '/'),
    }
    for way, found in shown.items():
        assert {name for name, _ in found} <= rights[way], way
    assert {name for name, _ in shown['served']} >= {'/autocalib/reset', '/autocalib/save', '/autocalib/calibrate'}


@pytest.mark.dds
def test_the_services_can_be_left_out(bench):
    node = bench.start(services=False)
    served = {name for name, _ in node.get_service_names_and_types_by_node('autocalib', '/')}
    assert not served & {'/autocalib/reset', '/autocalib/save', '/autocalib/calibrate'}
    assert '/autocalib/get_parameters' in served
