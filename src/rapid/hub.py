"""Agents and datasets to and from the Hugging Face Hub, with their cards.

The files of an agent and of a dataset have names of their own, and no other file is ever sent or fetched: nothing that
runs code can come along. What comes is loaded and checked beside its place, and put there whole. Who one is, the hub's
own client knows (``hf auth login`` or HF_TOKEN); no token passes through this module but to be cut out of messages.
"""

import os
import re
import shutil
import tempfile
from collections.abc import Generator, Iterable
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from rapid import files
from rapid.agents import card as agent_card
from rapid.agents.monitored import is_monitored
from rapid.agents.onnx import TOLERANCE, OnnxAgent
from rapid.agents.q_agent import QAgent
from rapid.agents.saved import CONFIG_FILE, WEIGHTS_FILE, load_agent
from rapid.agents.shipped import CARD_FILE, ONNX_FILE, agent_folder, is_shipped
from rapid.data.batch import with_rows
from rapid.data.card import card as dataset_card
from rapid.data.dataset import LICENCE, load_dataset
from rapid.data.dataset_files import DATASET_FILE, LOG_FILE, TRANSITIONS_FILE
from rapid.data.shipped import dataset_folder, shipped_sets
from rapid.errors import RapidError, how_to_install, sentence
from rapid.progress import task
from rapid.teacher.experience import MEMORY_FILE
from rapid.teacher.secrets import Secrets
from rapid.text import printable

README_FILE = "README.md"
_MOST_NAMED = 10


class _Kind(NamedTuple):
    """What can be sent: what it is called, here and on the hub, and the files that it has and that it may have."""

    name: str
    repo_type: str
    needed: tuple[str, ...]
    optional: tuple[str, ...]

    @property
    def files(self) -> tuple[str, ...]:
        return (*self.needed, *self.optional)


_AGENT = _Kind("agent", "model", (CONFIG_FILE, WEIGHTS_FILE), (CARD_FILE, ONNX_FILE))
_DATASET = _Kind("dataset", "dataset", (DATASET_FILE, TRANSITIONS_FILE), (LOG_FILE, MEMORY_FILE))


@dataclass(frozen=True)
class Transfer:
    """What was sent or fetched."""

    place: str
    """Where it is now: the address of the commit, or the directory."""
    revision: str
    """The commit."""
    files: tuple[str, ...]
    """What was transferred."""
    left_out: tuple[str, ...]
    """What was not: names from outside, with a reason where the name alone does not say it."""

    def told(self) -> str:
        """Return it in words, safe to print."""
        lines = [f"{self.place} (commit {self.revision[:12]}): {', '.join(self.files)}"]
        if self.left_out:
            more = len(self.left_out) - _MOST_NAMED
            names = ", ".join(self.left_out[:_MOST_NAMED]) + (f" and {more} more" if more > 0 else "")
            lines.append(f"Left out, as only the files of agents and datasets are transferred: {names}")
        return printable("\n".join(lines))


def push(path: str | os.PathLike[str], repository: str, public: bool = False) -> Transfer:
    """Send an agent or a dataset, in one commit, with a ``README.md`` written from what is known of it.

    Files that an earlier version had there and this one lacks are deleted there, others stay.

    Args:
        path: its directory, or the name of a shipped one.
        repository: OWNER/NAME on the hub; made, private unless `public`, if it is not there.
        public: whether everyone sees a repository that is made.

    Raises:
        RapidError: neither is at `path`, it is damaged, the name is none, nobody is logged in, or the hub refuses.
    """
    hub = _client()
    repo = _repository(repository)
    kind, folder = _located(path)
    if not (hub.get_token() or ""):
        raise RapidError(
            "Nobody is logged in to the Hugging Face Hub, and it takes files only from those it knows. Run `hf auth "
            "login`, or put a token with write access into the environment variable HF_TOKEN."
        )
    with tempfile.TemporaryDirectory(prefix="rapid-push-") as work:
        stage = Path(work) / kind.name
        stage.mkdir()
        for name in kind.files:
            if (folder / name).is_file():
                shutil.copyfile(folder / name, stage / name)
        readme, refused = _checked(kind, stage, repo)
        files.write_text(stage / README_FILE, readme)
        sent = tuple(name for name in (*kind.files, README_FILE) if (stage / name).is_file())
        with _asked(hub, repo):
            api = hub.HfApi()
            api.create_repo(repo, repo_type=kind.repo_type, private=not public, exist_ok=True)
            commit = api.upload_folder(
                repo_id=repo,
                folder_path=stage,
                repo_type=kind.repo_type,
                commit_message=f"Upload {kind.name} with RAPID",
                delete_patterns=[name for name in kind.files if name not in sent],
            )
    others = _others((entry.name for entry in folder.iterdir()), kind)
    return Transfer(str(commit.commit_url), str(commit.oid), sent, (*refused, *others))


def pull(repository: str, out: str | os.PathLike[str] = "", revision: str = "") -> Transfer:
    """Fetch an agent or a dataset, check it whole, and put it at `out`.

    Args:
        repository: OWNER/NAME on the hub; datasets/OWNER/NAME looks for a dataset only.
        out: its directory, by default NAME; nothing may be there but an empty one.
        revision: branch, tag or commit; the newest of the main branch by default.

    Raises:
        RapidError: something is at `out`, the hub or the repository cannot be read, or what it holds is no agent or
            dataset, or a damaged one. Nothing is at `out` then.
    """
    hub = _client()
    prefix = "datasets/" if repository.startswith("datasets/") else ""
    repo = _repository(repository.removeprefix(prefix))
    place = Path(out or repo.partition("/")[2])
    if os.path.lexists(place) and (not place.is_dir() or place.is_symlink() or any(place.iterdir())):
        raise RapidError(
            f"'{place}' exists and is not an empty directory. Choose another --out, so that nothing is overwritten."
        )
    kinds = (_DATASET,) if prefix else (_AGENT, _DATASET)
    with _asked(hub, repo, revision):
        kind, info = _found(hub, repo, kinds, revision)
    sizes: dict[str, int] = {entry.rfilename: entry.size or 0 for entry in info.siblings}
    wanted = [name for name in (*kind.files, README_FILE) if name in sizes]
    commit = str(info.sha or revision or "main")
    files.make_directory(place.parent)
    with tempfile.TemporaryDirectory(prefix=".rapid-pull-", dir=place.parent) as work:
        stage = Path(work) / "checked"
        stage.mkdir()
        with task(f"Fetching {repo}", sum(sizes[name] for name in wanted) / 1e6, "MB") as progress:
            for name in wanted:
                with _asked(hub, repo, revision):
                    # Of the commit that was looked at: a branch may move between two files.
                    got = hub.HfApi().hf_hub_download(
                        repo, name, repo_type=kind.repo_type, revision=commit, local_dir=Path(work) / "fetched"
                    )
                with files.atomic_path(stage / name) as temporary:
                    shutil.copyfile(got, temporary)
                progress.advance(sizes[name] / 1e6)
        try:
            _, refused = _checked(kind, stage, repo)
        except RapidError as error:
            said = str(error).replace(str(stage), repo)
            raise RapidError(f"What '{repo}' holds was not put at '{place}', as it is damaged. {said}") from error
        if place.is_dir():
            place.rmdir()  # it is empty; some systems rename onto no directory at all
        stage.rename(place)
        files.sync_directory(place.parent)
    fetched = tuple(name for name in wanted if (place / name).is_file())
    return Transfer(str(place), commit, fetched, (*refused, *_others(sizes, kind)))


def _client() -> Any:
    """Return the hub's client, silent and without telemetry."""
    os.environ.setdefault("HF_HUB_DISABLE_TELEMETRY", "1")
    try:
        import huggingface_hub
        from huggingface_hub.utils import disable_progress_bars
    except ImportError as error:
        raise RapidError(f"The Hugging Face Hub needs its client. Install it: {how_to_install('hub')}") from error
    if os.environ.get("HF_HUB_DISABLE_PROGRESS_BARS") is None:
        disable_progress_bars()
    return huggingface_hub


def _repository(name: str) -> str:
    part = r"[A-Za-z0-9](?:[A-Za-z0-9._-]{0,94}[A-Za-z0-9])?"
    if not re.fullmatch(f"{part}/{part}", name) or "--" in name or ".." in name or name.endswith(".git"):
        raise RapidError(
            f"'{name}' is no repository of the Hugging Face Hub. Give OWNER/NAME, of letters, digits and single marks "
            "of . _ - between them, such as alice/lane-3-pupil."
        )
    return name


def _located(path: str | os.PathLike[str]) -> tuple[_Kind, Path]:
    """Return what is at a path, and its directory."""
    is_set = is_shipped(path) and os.fspath(path).partition(":")[2] in shipped_sets()
    if not is_set and is_monitored(path):
        raise RapidError(
            f"'{path}' is two policies with a monitor between them, and the Hub takes one agent at a time. Push "
            f"'{agent_folder(path) / 'calm'}' and '{agent_folder(path) / 'wary'}', each into a repository of its own."
        )
    if is_shipped(path):
        return (_DATASET, dataset_folder(path)) if is_set else (_AGENT, agent_folder(path))
    folder = Path(path)
    for kind in (_DATASET, _AGENT):
        if (folder / kind.needed[0]).is_file():
            return kind, folder
    raise RapidError(
        f"'{folder}' is neither an agent nor a dataset: it has no {CONFIG_FILE} and no {DATASET_FILE}. Give the "
        "directory that `rapid distill`, `rapid adapt`, `rapid collect` or `rapid mix` wrote."
    )


def _found(hub: Any, repo: str, kinds: Iterable[_Kind], revision: str) -> tuple[_Kind, Any]:
    """Return the first kind that a repository of this name is whole of, and what the hub says of it."""
    lacking: list[str] = []
    absent: Exception | None = None
    for kind in kinds:
        try:
            info = hub.HfApi().repo_info(
                repo, repo_type=kind.repo_type, revision=revision or None, files_metadata=True, timeout=30
            )
        except hub.errors.GatedRepoError:
            raise
        except hub.errors.RepositoryNotFoundError as error:
            absent = error
            continue
        names = {entry.rfilename for entry in info.siblings or ()}
        missing = [name for name in kind.needed if name not in names]
        if not missing:
            return kind, info
        lacking.append(f"as {kind.name} it lacks {' and '.join(missing)}")
    if absent is not None and not lacking:
        raise absent
    raise RapidError(
        f"The repository '{repo}' holds no agent or dataset of RAPID: {'; '.join(lacking)}. RAPID fetches what "
        "`rapid push` has put there."
    )


def _checked(kind: _Kind, folder: Path, repo: str) -> tuple[str, list[str]]:
    """Load what is in a directory of our own and return its card, and what was taken out, with the reason.

    Raises:
        RapidError: it is damaged, or its parts do not belong together.
    """
    if kind is _DATASET:
        dataset = load_dataset(folder)
        head = agent_card.front_matter(
            ["offline-reinforcement-learning"],
            LICENCE,
            configs=[{"config_name": "transitions", "data_files": TRANSITIONS_FILE}],
        )
        return head + dataset_card(dataset), []
    agent = load_agent(folder)
    about: Any = {}
    if (folder / CARD_FILE).is_file():
        about = files.read_json(folder / CARD_FILE, "card of an agent")
        if not isinstance(about, dict):
            raise RapidError(f"'{folder / CARD_FILE}' is no card of an agent. Remove it, or make it again.")
        digest = about.get("weights_sha256")
        if digest is not None and digest != files.sha256(folder / WEIGHTS_FILE):
            raise RapidError(
                f"The card {CARD_FILE} is of other weights than {WEIGHTS_FILE}, so its scores are not this agent's. "
                "Remove the card, or make it again."
            )
    refused: list[str] = []
    if (folder / ONNX_FILE).is_file() and (fault := _onnx_fault(agent, folder / ONNX_FILE)):
        (folder / ONNX_FILE).unlink()
        refused.append(f"{ONNX_FILE} ({fault}; `rapid export` makes it)")
    return agent_card.markdown(agent, about, repo), refused


def _onnx_fault(agent: QAgent, path: Path) -> str:
    """Return why an ONNX file is not this agent, or nothing: they are compared on observations that are shipped."""
    seen_NVF = load_dataset("shipped:lane-3-density-2/teacher").transitions.obs_NVF[:256]
    obs_BVF = with_rows(torch.from_numpy(seen_NVF), agent.vehicles).numpy()
    state_BS = agent.start(len(obs_BVF)) if agent.has_memory else None
    try:
        values_BA = OnnxAgent(path).q_values(obs_BVF, state_BS)
    except RapidError as error:
        return "onnxruntime, which would check it, is not installed" if _without_runtime() else str(error)
    except Exception as error:  # onnxruntime's errors share no base class, and the file is anybody's
        return f"it cannot be run: {type(error).__name__}"
    expected_BA = agent.q_values(obs_BVF, state_BS)
    close = np.abs(values_BA - expected_BA).max() <= TOLERANCE * max(1.0, float(np.abs(expected_BA).max()))
    return "" if close else "it is not the network of the weights"


def _without_runtime() -> bool:
    from importlib.util import find_spec

    return find_spec("onnxruntime") is None


def _others(names: Iterable[str], kind: _Kind) -> list[str]:
    return sorted(name for name in names if name not in (*kind.files, README_FILE, ".gitattributes"))


@contextmanager
def _asked(hub: Any, repo: str, revision: str = "") -> Generator[None, None, None]:
    """Turn what the client raises in the block into what to do about it, without any token."""
    try:
        yield
    except RapidError:
        raise
    except Exception as error:  # the client raises errors of many libraries
        token = hub.get_token() or ""
        said = Secrets([token]).clean(printable(str(error))).strip()
        first = sentence(f"{type(error).__name__}: {said.splitlines()[0]}" if said else type(error).__name__)
        if token in first and token:
            first = sentence(type(error).__name__)
        raise RapidError(_advice(hub, error, repo, revision, bool(token), first)) from error


def _advice(hub: Any, error: Exception, repo: str, revision: str, known: bool, said: str) -> str:
    errors = hub.errors
    login = "Your token may not see it." if known else "Nobody is logged in: run `hf auth login`, or set HF_TOKEN."
    status = getattr(getattr(error, "response", None), "status_code", 0) or 0
    if isinstance(error, errors.OfflineModeIsEnabled):
        return "The Hugging Face Hub is not asked, as HF_HUB_OFFLINE or TRANSFORMERS_OFFLINE is set. Unset it."
    if isinstance(error, errors.GatedRepoError):
        return f"The repository '{repo}' is open only to those whom its owner lets in. Ask there for access. {login}"
    if isinstance(error, errors.RepositoryNotFoundError):
        return f"The hub shows no repository '{repo}': there is none, or it is private. Check OWNER/NAME. {login}"
    if isinstance(error, errors.RevisionNotFoundError):
        return f"The repository '{repo}' has no revision '{revision}'. Name a branch, a tag or a commit of it."
    if status in (401, 403):
        return f"The hub does not let you do this with '{repo}'. {login} A push needs a token with write access. {said}"
    if status == 429:
        return f"The hub has had too many requests from here. Wait some minutes, then give the same command. {said}"
    if 400 <= status < 500:
        return f"The hub refuses this for '{repo}': {said} Check the name and what is there."
    return f"The Hugging Face Hub cannot be reached or is out of order: {said} Check the network, or try again later."
