"""The kinds that are installed: listing them imports nothing, loading one imports its module alone."""

from __future__ import annotations

import dataclasses
import functools
import importlib.metadata
from collections.abc import Iterable, Mapping
from difflib import get_close_matches

import pluggy

from fls_flow import hookspecs
from fls_flow.errors import PluginError
from fls_flow.kinds import InPort, Kind, Listing, OutPort, Parameter, cause_of, describe

__all__ = ["Catalog", "InPort", "Kind", "Listing", "OutPort", "Parameter", "describe", "suggest"]

TYPO = 0.75  # names that are so much alike (difflib's ratio) are one name, misspelt


def suggest(name: str, among: Iterable[str]) -> str:
    """`; did you mean 'x'?` for the name nearest to `name`, or nothing."""
    near = _nearest(name, among, 0.6)
    return f"; did you mean '{near}'?" if near else ""


def _nearest(name: str, among: Iterable[str], cutoff: float) -> str | None:
    """The name that `name` is most like, whatever the case of its letters."""
    written = {one.lower(): one for one in among}
    near = get_close_matches(name.lower(), list(written), n=1, cutoff=cutoff)
    return written[near[0]] if near else None


class Catalog:
    """The installed kinds, and those that a test or a notebook adds as classes."""

    def __init__(self, extra: Mapping[str, type] | None = None) -> None:
        self._extra = dict(extra or {})
        self._loaded: dict[str, Kind] = {}

    def listings(self) -> tuple[Listing, ...]:
        """Every installed kind, sorted by name; a name that two distributions claim stands twice."""
        return tuple(listing for listing, _ in self._entries)

    def names(self) -> list[str]:
        """The names of all kinds."""
        return sorted({one.kind for one in self.listings()} | set(self._extra))

    def load(self, name: str) -> Kind:
        """The kind of that name.

        Raises PluginError when there is none, when two distributions claim it, or when its module breaks the
        contract.
        """
        if name not in self._loaded:
            extra = self._extra.get(name)
            self._loaded[name] = self._installed(name) if extra is None else describe(extra, name)
        return self._loaded[name]

    def meant(self, name: str) -> Kind | None:
        """The kind whose name was misspelt as `name`: all but certainly, and fit to be loaded."""
        near = None if name in self.names() else _nearest(name, self.names(), TYPO)
        try:
            return self.load(near) if near is not None else None
        except PluginError:
            return None

    def _installed(self, name: str) -> Kind:
        entries = [(listing, entry) for listing, entry in self._entries if listing.kind == name]
        if not entries:
            near = suggest(name, self.names())
            raise PluginError(f"unknown kind '{name}'{near or '; fls-flow plugins lists the installed ones'}")
        if len(entries) > 1:
            owners = " and ".join(_owner(listing) for listing, _ in entries)
            raise PluginError(f"kind '{name}' is claimed by {owners}; uninstall one of them")
        listing, entry = entries[0]
        return dataclasses.replace(describe(_hooked(entry, listing), name), listing=listing)

    @functools.cached_property
    def _entries(self) -> list[tuple[Listing, importlib.metadata.EntryPoint]]:
        """What is installed, read from the disk once."""
        found = [(_listing(one), one) for one in importlib.metadata.entry_points(group=hookspecs.PROJECT)]
        return sorted(found, key=lambda one: (one[0].kind, one[0].distribution, one[0].module))


def _listing(entry: importlib.metadata.EntryPoint) -> Listing:
    read = entry.dist.metadata if entry.dist else None  # each look at it reads the file anew
    metadata = {key: read[key] for key in read} if read else {}
    return Listing(
        entry.name, metadata.get("Name", "unknown"), metadata.get("Version", "unknown"), entry.value
    )


def _owner(listing: Listing) -> str:
    return f"{listing.distribution} {listing.version} ({listing.module})"


def _hooked(entry: importlib.metadata.EntryPoint, listing: Listing) -> type:
    """The class that the module's `fls_node` hook returns; each module gets a plugin manager of its own."""
    blame = f"kind '{listing.kind}' of {_owner(listing)}"
    try:
        module = entry.load()
    except (Exception, SystemExit) as error:
        cause = cause_of(error)
        raise PluginError(f"{blame} cannot be imported: {cause}; mend or uninstall it") from error
    manager = pluggy.PluginManager(hookspecs.PROJECT)
    manager.add_hookspecs(hookspecs)
    try:
        manager.register(module, name=listing.module)
        manager.check_pending()
        found = manager.hook.fls_node()
    except pluggy.PluginValidationError as error:
        reason = " ".join(str(error).split())
        raise PluginError(f"{blame} has a wrong hook: {reason}; the hook is fls_node()") from error
    except Exception as error:
        raise PluginError(f"{blame}: fls_node() raised {cause_of(error)}; mend or uninstall it") from error
    if len(found) != 1 or not isinstance(found[0], type):
        raise PluginError(f"{blame} has no `@hookimpl def fls_node()` that returns a class")
    return found[0]
