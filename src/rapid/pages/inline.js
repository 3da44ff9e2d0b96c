// One or two driven episodes in a notebook's cell: the player, and nothing to choose.

const data = JSON.parse(document.getElementById("payload").textContent);
const root = element("figure", { class: "player", tabindex: 0, "aria-label": "player: space plays and pauses, arrow keys step, c goes to the crash" });
document.getElementById("inline").append(root);
const player = makePlayer(root, { names: data.actions, more: () => {} });
data.episodes.forEach((episode, i) => {
  player.addPane().head.prepend(element("b", {}, episode.label));
  player.show(i, episode);
});
