"""`livessl keys`: key pairs of the server and of nodes, and access tokens of clients."""

from __future__ import annotations

import argparse
import json
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from livessl.cli import argument
from livessl.cli.exits import OK
from livessl.cli.options import add_json, add_site
from livessl.errors import ConfigError, Fault

ROLES: Final = ("viewer", "operator", "admin")
"""Names of the roles, as in `livessl.site.tokens.Role`, which takes longer to import than help may take."""

ONE_OBJECT: Final = "print one JSON object"


def add_arguments(parser: Any) -> None:
    """Describe the command's arguments."""
    actions = parser.add_subparsers(title="actions", metavar="ACTION", required=True)

    def action(name: str, act: Callable[[argparse.Namespace], int], text: str, example: str) -> Any:
        sub = actions.add_parser(
            name, help=text, description=text[0].upper() + text[1:] + ".", epilog=f"example: livessl keys {example}"
        )
        sub.set_defaults(act=act)
        add_site(sub)
        return sub

    sub = action("server", _server, "make the server's key pair", "server --site site.yaml")
    add_json(sub, ONE_OBJECT)
    text, example = (
        "make a node's key pair (run this command on the node)",
        "node lab-pc --site site.yaml --server 4f8a…",
    )
    sub = action("node", _node, text, example)
    sub.add_argument(
        "name",
        help="name of the node in the site file, or `replay` for the key with which `livessl replay --server` connects",
    )
    sub.add_argument(
        "--server", type=argument.key, metavar="KEY", help="the server's public key, as `keys server` printed it"
    )
    add_json(sub, ONE_OBJECT)
    sub = action(
        "enrol", _enrol, "admit a node (run this command on the server)", "enrol lab-pc 9c01… --site site.yaml"
    )
    sub.add_argument("name", help="name of the node in the site file")
    sub.add_argument("key", type=argument.key, help="the node's public key, as `keys node` printed it")
    sub = action(
        "token", _token, "make an access token for a client", "token --site site.yaml --name wall --role viewer"
    )
    sub.add_argument("--name", required=True, help="name of the client, by which its token can be revoked")
    sub.add_argument(
        "--role",
        choices=ROLES,
        default="viewer",
        help="viewer: read everything except sound, clients and log; operator: also listen, and change arrays, zones, "
        "rules and poses; admin: also read clients, refused callers and the log (default: viewer)",
    )
    add_json(sub, ONE_OBJECT)
    sub = action(
        "revoke", _revoke, "remove the key of a node or the token of a client", "revoke --site site.yaml --token wall"
    )
    which = sub.add_mutually_exclusive_group(required=True)
    which.add_argument(
        "--node", metavar="NAME", help="node whose key to remove; restart a running server to disconnect it"
    )
    which.add_argument(
        "--token", metavar="NAME", help="client whose token to revoke; a running server refuses it within a second"
    )
    sub = action("list", _list, "list the nodes and clients that may connect", "list --site site.yaml")
    add_json(sub, ONE_OBJECT)


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    return int(arguments.act(arguments))


def _folder(arguments: argparse.Namespace) -> Path:
    from livessl.site.load import load_site

    site = load_site(arguments.site)
    if site.keys is None:
        what = "expected the folder that holds the keys, got none; add keys: keys to the site file"
        raise ConfigError([Fault(f"{arguments.site}: keys", what)])
    return site.file(site.keys)


def _tokens_file(arguments: argparse.Namespace) -> Path:
    from livessl.site.load import load_site

    site = load_site(arguments.site)
    if site.server.http.tokens is None:
        what = "expected the file that holds the tokens, got none; add tokens: tokens.yaml to server.http"
        raise ConfigError([Fault(f"{arguments.site}: server.http.tokens", what)])
    return site.file(site.server.http.tokens)


def _server(arguments: argparse.Namespace) -> int:
    from livessl.site import keys

    key = keys.make_server_keys(_folder(arguments))
    print(json.dumps({"public_key": key.hex()}) if arguments.json else key.hex())
    logging.info(
        "this is the server's public key; on each node run: livessl keys node NAME --site SITE --server %s", key.hex()
    )
    return OK


def _node(arguments: argparse.Namespace) -> int:
    from livessl.site import keys

    key = keys.make_node_keys(_folder(arguments), arguments.name, arguments.server)
    print(json.dumps({"name": arguments.name, "public_key": key.hex()}) if arguments.json else key.hex())
    logging.info(
        "this is the node's public key; on the server run: livessl keys enrol %s %s --site SITE",
        arguments.name,
        key.hex(),
    )
    return OK


def _enrol(arguments: argparse.Namespace) -> int:
    from livessl.site import keys

    keys.enrol(_folder(arguments), arguments.name, arguments.key)
    logging.info("node %r is enrolled; restart a running server to admit it", arguments.name)
    return OK


def _token(arguments: argparse.Namespace) -> int:
    from livessl.site import tokens

    token = tokens.add_token(_tokens_file(arguments), arguments.name, arguments.role)
    print(json.dumps({"name": arguments.name, "role": arguments.role, "token": token}) if arguments.json else token)
    logging.info("store the token now, because it is shown only once; a running server accepts it within a second")
    return OK


def _revoke(arguments: argparse.Namespace) -> int:
    from livessl.site import keys, tokens

    if arguments.node is not None:
        keys.dismiss(_folder(arguments), arguments.node)
        logging.info("node %r is no longer enrolled; restart a running server to disconnect it", arguments.node)
    else:
        tokens.revoke_token(_tokens_file(arguments), arguments.token)
        logging.info("a running server refuses the token within a second")
    return OK


def _list(arguments: argparse.Namespace) -> int:
    from livessl.site import keys, tokens
    from livessl.site.load import load_site

    site = load_site(arguments.site)
    nodes = {} if site.keys is None else keys.enrolled(site.file(site.keys))
    file = site.server.http.tokens
    clients = () if file is None else tokens.read_tokens(site.file(file)).clients
    if arguments.json:
        listed = [{"name": client.name, "role": str(client.role)} for client in clients]
        print(json.dumps({"nodes": {name: key.hex() for name, key in nodes.items()}, "clients": listed}))
        return OK
    for name, key in nodes.items():
        print(f"node    {name:<20} {key.hex()}")
    for client in clients:
        print(f"client  {client.name:<20} {client.role}")
    return OK
