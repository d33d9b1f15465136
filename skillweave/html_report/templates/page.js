"use strict";
// Draws the charts and the timelines from the data in the page, and joins timelines and film.
(() => {
  const $ = (id) => document.getElementById(id);
  const data = JSON.parse($("data").textContent);
  const make = (tag, attributes = {}, ...children) => {
    const element = document.createElement(tag);
    for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
    element.append(...children);
    return element;
  };
  const plain = (x) => x.toLocaleString("en", { maximumSignificantDigits: 4 }).replace("-", "−");
  // A pause that comes before the first picture rejects play(): nothing is wrong then.
  const play = (video) => video.play().catch((error) => {
    if (error.name !== "AbortError") throw error;
  });
  const signed = (x) => (x > 0 ? "+" : "") + plain(x);

  // Charts

  const drawn = new Map(); // by element, how to draw it again when the colours change
  const colours = () => {
    const css = getComputedStyle(document.documentElement);
    const [ink, soft, grid] = ["--ink", "--soft", "--grid"].map((k) => css.getPropertyValue(k).trim());
    const font = getComputedStyle(document.body).fontFamily;
    const axis = { labelColor: soft, titleColor: soft, gridColor: grid, domainColor: grid, tickColor: grid };
    const sizes = { labelFontSize: 12, titleFontSize: 12, titleFontWeight: "normal", titlePadding: 8 };
    return {
      background: "transparent", font,
      axis: { ...axis, ...sizes },
      legend: { labelColor: ink, titleColor: soft, labelFontSize: 13, symbolSize: 90, columns: 4, labelLimit: 240 },
      view: { stroke: null },
      rule: { color: soft }, text: { color: ink },
    };
  };
  const draw = (element, spec) => {
    const again = async () => {
      drawn.get(element).view?.finalize();
      const options = { actions: false, renderer: "svg", config: colours(), tooltip: { disableDefaultStyle: true } };
      drawn.get(element).view = (await vegaEmbed(element, structuredClone(spec), options)).view;
    };
    drawn.set(element, { again, view: drawn.get(element)?.view });
    return again();
  };
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
    for (const { again } of drawn.values()) again();
  });

  // Learning curves

  const drawCurves = () => {
    const metric = $("metric").value;
    (data.curves ?? []).forEach((curve, i) => {
      const element = $(`curve-${i}`);
      const points = curve.points[metric];
      element.hidden = !points;
      element.parentElement.hidden = !points; // this agent has no such metric
      if (!points) return;
      const spec = structuredClone(curve.spec);
      // A run's points are steps and a value; a group's have an interval and the group's name, too.
      spec.data = { values: points.map(([x, y, lo, hi, what]) => ({ x, y, lo, hi, what })) };
      // A line of one point is not to be seen.
      if (points.length < 3) for (const { mark } of spec.layer) if (mark.type === "line") mark.point = true;
      const title = metric.replaceAll("_", " ");
      for (const part of [spec, ...(spec.layer ?? [])]) if (part.encoding?.y) part.encoding.y.title = title;
      draw(element, spec);
    });
  };
  if (data.curves && $("metric")) {
    $("metric").addEventListener("change", drawCurves);
    drawCurves();
  }
  (data.trees ?? []).forEach((tree, i) => {
    draw($(`tree-${i}`), tree.tree);
    tree.paths.forEach((spec, k) => draw($(`path-${i}-${k}`), spec));
  });
  for (const [id, spec] of Object.entries(data.charts ?? {})) draw($(id), spec);

  // Calls: of each field a list in the page, here an object for each call. Its fields are those of a
  // recorder's rows, with `skill`, a place in data.labels, and `goal`, in words.

  const objects = (columns) => columns.skill.map((_, i) =>
    Object.fromEntries(Object.entries(columns).map(([name, values]) => [name, values[i]])));
  for (const part of [...(data.episodes ?? []), data.decisions]) if (part) part.calls = objects(part.calls);
  const outcome = ({ skill, succeeded }, [yes, no, unknown]) =>
    (data.judged[skill] ? (succeeded ? yes : no) : unknown);

  // The selector's choices

  const results = ["success", "no success", "not known"];
  const drawChoices = () => {
    const { names, rows, calls, spec } = data.decisions;
    const [across, up] = [$("across"), $("up")].map((s) => Number(s.value));
    const bySuccess = $("hue").value === "success";
    const word = (call) => (bySuccess ? outcome(call, results) : data.labels[call.skill]);
    const values = rows.map((row, i) =>
      ({ x: row[across], y: row[up], what: word(calls[i]), goal: calls[i].goal || "none" }));
    const shown = structuredClone(spec);
    shown.data = { values };
    const titles = { x: names[across], y: names[up] };
    shown.encoding.x.title = titles.x;
    shown.encoding.y.title = titles.y;
    shown.encoding.tooltip[1].title = titles.x;
    shown.encoding.tooltip[2].title = titles.y;
    if (bySuccess) {
      shown.encoding.tooltip[0].title = "call";
      shown.encoding.color.scale = { domain: results, range: ["#009e73", "#d55e00", "#8d8d97"] };
      shown.encoding.shape.scale = { domain: results, range: ["circle", "cross", "square"] };
    }
    draw($("choices"), shown);
  };
  if (data.decisions) {
    const { names, rows, calls } = data.decisions;
    $("choices-none").hidden = rows.length > 0;
    $("choices-some").hidden = rows.length === 0;
    if (rows.length) {
      for (const id of ["across", "up"]) {
        $(id).append(...names.map((name, i) => make("option", { value: i }, name)));
        $(id).addEventListener("change", drawChoices);
      }
      $("up").value = Math.min(1, names.length - 1);
      $("hue").parentElement.hidden = !calls.some((call) => data.judged[call.skill]);
      $("hue").addEventListener("change", drawChoices);
      drawChoices();
    }
  }

  // Films: one file each, with the skills' names and goals as captions

  const withGoal = (skill, goal) => [skill, goal].filter(Boolean).join(" ");
  const load = (video, id, fps, cues) => {
    const bytes = Uint8Array.from(atob($(id).textContent.trim()), (c) => c.charCodeAt(0));
    video.src = URL.createObjectURL(new Blob([bytes], { type: "video/mp4" }));
    const stamp = (frame) => new Date((1000 * frame) / fps).toISOString().slice(11, 23);
    const lines = cues.filter(([from, to]) => to > from)
      .map(([from, to, text]) => `${stamp(from)} --> ${stamp(to)}\n${text}\n`);
    const captions = new Blob([`WEBVTT\n\n${lines.join("\n")}`], { type: "text/vtt" });
    video.append(make("track", { kind: "captions", label: "Skills", srclang: "en", src: URL.createObjectURL(captions) }));
  };

  // Handover: the chosen cell, its films and its calls

  const handover = () => {
    const { cells, colors, words, names, points, spec, film } = data.handover;
    const video = $("pair-video");
    const buttons = [...document.querySelectorAll("#pairs button")];
    let cell, clip;

    const drawCalls = () => {
      const [across, up] = ["pair-across", "pair-up"].map((id) => Number($(id).value));
      const first = Number($("pair-when").value) * names.length;
      const shown = structuredClone(spec);
      shown.data = { values: points[cell].map((row) => ({
        x: row[first + across], y: row[first + up], what: words[row[2 * names.length] ? 0 : 1] })) };
      for (const [axis, i] of [["x", across], ["y", up]]) shown.encoding[axis].title = names[i];
      [across, up].forEach((i, k) => { shown.encoding.tooltip[k + 1].title = names[i]; });
      // One scale for all cells, so that they can be compared.
      for (const [axis, i] of [["x", across], ["y", up]]) {
        const all = Object.values(points).flat().flatMap((row) => [row[i], row[names.length + i]]);
        shown.encoding[axis].scale.domain = [Math.min(...all), Math.max(...all)];
      }
      draw($("pair-chart"), shown);
    };

    const show = (i) => {
      clip = cells[cell].clips[i];
      [...$("pair-clips").children].forEach((b, k) => b.setAttribute("aria-pressed", String(k === i)));
      if (clip) video.currentTime = (clip.from + 0.5) / film.fps;
    };

    const select = (id) => {
      cell = id;
      buttons.forEach((b) => b.setAttribute("aria-pressed", String(b.dataset.cell === id)));
      const { skill, before, done, interval, ends, clips } = cells[id];
      const chip = make("span", { class: "chip", style: `background:${colors[skill] ?? "#8d8d97"}` });
      $("pair-title").replaceChildren(chip, before ? `${skill} after ${before}` : `${skill} at the start of an episode`);
      const rows = [["Done", done], ["95 % interval", interval], ["Calls ended", ends]];
      $("pair").replaceChildren(...rows.map(([k, v]) => make("div", {}, make("dt", {}, k), make("dd", {}, v))));
      if (names.length) drawCalls();
      if (!video) return;
      $("pair-clips").replaceChildren(...clips.map((c, i) => {
        const button = make("button", { type: "button" }, `${c.done ? "done" : "not done"}, ${c.steps} steps`);
        button.addEventListener("click", () => { show(i); play(video); });
        return button;
      }));
      video.pause();
      video.hidden = !clips.length;
      $("pair-now").textContent = clips.length ? "" : "None of these calls is in the film.";
      show(0);
    };

    buttons.forEach((b) => b.addEventListener("click", () => select(b.dataset.cell)));
    if (names.length) {
      $("pair-some").hidden = false;
      for (const id of ["pair-across", "pair-up"]) {
        $(id).append(...names.map((name, i) => make("option", { value: i }, name)));
        $(id).addEventListener("change", drawCalls);
      }
      $("pair-up").value = Math.min(1, names.length - 1);
      $("pair-when").addEventListener("change", drawCalls);
    }
    if (video) {
      load(video, "hand-film", film.fps, Object.values(cells).flatMap(({ skill, before, clips }) =>
        clips.flatMap((c) => [
          [c.from, c.call, `${withGoal(before, c.before_goal)} ends`], [c.call, c.to, withGoal(skill, c.goal)]])));
      const follow = () => {
        if (!clip) return;
        const frame = Math.floor(video.currentTime * film.fps + 1e-3);
        if (frame >= clip.to || frame < clip.from) {
          video.pause();
          if (frame > clip.to || frame < clip.from) video.currentTime = (clip.from + 0.5) / film.fps;
        }
        const { skill, before } = cells[cell];
        $("pair-now").textContent = frame < clip.call ? `${withGoal(before, clip.before_goal)} ends` :
          `${withGoal(skill, clip.goal)}: ${clip.done ? "done" : "not done"} after ${clip.steps} steps`;
      };
      video.addEventListener("timeupdate", follow);
      video.addEventListener("seeked", follow);
      const everyFrame = () => {
        follow();
        if (!video.paused) requestAnimationFrame(everyFrame);
      };
      video.addEventListener("play", () => {
        if (clip && video.currentTime * film.fps >= clip.to - 1) video.currentTime = (clip.from + 0.5) / film.fps;
        everyFrame();
      });
      video.addEventListener("loadedmetadata", () => show(0), { once: true });
    }
    select((document.querySelector("#pairs .weak button") ?? buttons[0]).dataset.cell);
  };
  if (data.handover && document.querySelector("#pairs button")) handover();

  // Episodes: timelines, the chosen call, the film

  if (!data.episodes) return;
  const video = $("video");
  const shownFirst = (e, place) => (data.episodes[0].frame === null ? place < 3 : e.frame !== null);
  // Bars of one list have one scale.
  const longest = [true, false].map((first) =>
    Math.max(1, ...data.episodes.filter((e, place) => shownFirst(e, place) === first).map((e) => e.steps)));
  const room = (name) => (name.length < 6 ? "few" : name.length < 11 ? "some" : "many");
  const tracks = []; // by place in data.episodes: the listbox and its options
  let chosen = { episode: -1, call: -1 };

  const nameOf = (episode) => {
    const filmed = data.episodes.filter((e) => e.frame !== null).length;
    const place = data.episodes.indexOf(episode);
    if (episode.frame === null || filmed < 2) return "";
    return place === 0 ? "the worst" : place === filmed - 1 ? "the best" : filmed === 3 ? "the median" : "";
  };
  // The skill of a call, with its goal.
  const called = ({ skill, goal }) => withGoal(data.labels[skill], goal);
  const words = (call, i) =>
    `call ${i + 1}: ${called(call)}, from step ${call.age}, ${call.steps} steps, ended ${data.why[call.end_reason]}, ` +
    `reward ${signed(call.task_return)}${outcome(call, [", success", ", no success", ""])}`;

  const result = ({ return: total }) =>
    data.binary ? (total > 0 ? "solved" : "not solved") : `return ${signed(total)}`;
  const timeline = (episode, place) => {
    const rank = nameOf(episode);
    const cut = episode.cut ? ", cut before its end" : "";
    const count = episode.calls.length === 1 ? "1 call" : `${episode.calls.length} calls`;
    const title = make("h3", { id: `episode-${place}` }, make("strong", {}, `Episode ${episode.number}`),
      `${rank ? ` (${rank})` : ""}: ${result(episode)}, ${episode.steps} steps, ${count}${cut}`);
    const track = make("div", {
      class: "track", role: "listbox", tabindex: 0, "aria-labelledby": `episode-${place}`,
      "aria-orientation": "horizontal", style: `width:${(100 * episode.steps) / longest[shownFirst(episode, place) ? 0 : 1]}%`,
    });
    const options = episode.calls.map((call, i) => {
      const { skill, age, steps } = call;
      const option = make("div", {
        class: "call", role: "option", id: `call-${place}-${i}`, "aria-selected": "false", title: words(call, i),
        "aria-label": words(call, i),
        style: `left:${(100 * age) / episode.steps}%;width:${(100 * steps) / episode.steps}%`,
      }, make("span", { style: `background:${data.colors[skill]};color:${data.inks[skill]}` },
        make("b", { class: room(data.labels[skill]) }, data.labels[skill])));
      option.addEventListener("click", () => choose(place, i));
      return option;
    });
    track.append(...options);
    track.addEventListener("keydown", (event) => press(event, place));
    track.addEventListener("focus", () => {
      if (chosen.episode !== place && track.matches(":focus-visible")) choose(place, 0);
    });
    tracks[place] = { track, options };
    return make("div", { class: "row" }, title, track);
  };

  const press = (event, place) => {
    const last = data.episodes[place].calls.length - 1;
    const at = chosen.episode === place ? chosen.call : 0;
    const to = { ArrowLeft: at - 1, ArrowRight: at + 1, ArrowUp: at - 1, ArrowDown: at + 1, Home: 0, End: last }[event.key];
    if (to !== undefined) choose(place, Math.min(Math.max(to, 0), last));
    else if ((event.key === " " || event.key === "Enter") && video) video.paused ? play(video) : video.pause();
    else return;
    event.preventDefault();
  };

  const choose = (place, i, seek = true) => {
    const changed = chosen.episode !== place;
    tracks[chosen.episode]?.options[chosen.call]?.setAttribute("aria-selected", "false");
    chosen = { episode: place, call: i };
    const { track, options } = tracks[place];
    options[i].setAttribute("aria-selected", "true");
    track.setAttribute("aria-activedescendant", options[i].id);
    const episode = data.episodes[place];
    tell(episode, i);
    if (changed) fillTable(place);
    [...$("calls").tBodies[0].rows].forEach((row, k) => row.setAttribute("aria-current", String(k === i)));
    if (seek && video && episode.frame !== null) {
      const frame = episode.frame + Math.ceil(episode.calls[i].age / data.film.every);
      video.currentTime = (frame + 0.5) / data.film.fps;
    }
  };

  const ownReward = ({ own_return }) => (own_return === null ? "–" : signed(own_return));
  const success = (call) => outcome(call, ["yes", "no", "–"]);
  const tell = (episode, i) => {
    const call = episode.calls[i];
    const { skill, age, steps } = call;
    const chip = make("span", { class: "chip", style: `background:${data.colors[skill]}` });
    $("call-title").replaceChildren(chip, `Call ${i + 1} of ${episode.calls.length}: ${data.labels[skill]}`);
    const rows = [
      ["Episode", `${episode.number}, seed ${episode.seed}`],
      ["Goal", call.goal],
      ["Steps", `${age} to ${age + steps} (${steps})`],
      ["Ended", data.why[call.end_reason]],
      ["Reward", signed(call.task_return)],
      ["Its own reward", ownReward(call)],
      ["Success", success(call)],
      ["Film", video && episode.frame === null ? "this episode is not in it" : ""],
    ].filter(([, shown]) => shown && shown !== "–");
    const observed = (episode.seen?.[i] ?? []).map((x, k) => [data.seen[k], plain(x)]);
    $("seen").hidden = !observed.length;
    $("seen").querySelector("dl").replaceChildren(
      ...observed.map(([k, v]) => make("div", {}, make("dt", {}, k), make("dd", {}, v))));
    $("call").replaceChildren(...rows.map(([k, v]) => make("div", {}, make("dt", {}, k), make("dd", {}, v))));
  };

  const fillTable = (place) => {
    const rows = data.episodes[place].calls.map((call, i) => {
      const button = make("button", { type: "button", "aria-label": `Show call ${i + 1}` }, String(i + 1));
      button.addEventListener("click", () => choose(place, i));
      const cell = (text, numeric) => make("td", numeric ? { class: "num" } : {}, String(text));
      const first = make("td", { class: "num" }, button);
      return make("tr", {}, first, cell(called(call)), cell(call.age, true), cell(call.steps, true),
        cell(data.why[call.end_reason]), cell(signed(call.task_return), true), cell(ownReward(call), true),
        cell(success(call)));
    });
    $("calls").tBodies[0].replaceChildren(...rows);
  };

  data.episodes.forEach((episode, place) => {
    (shownFirst(episode, place) ? $("timelines") : $("more-timelines")).append(timeline(episode, place));
  });
  const more = $("more-timelines").children.length;
  $("more").hidden = !more;
  const without = data.episodes[0].frame === null ? "" : " without film";
  $("more").querySelector("summary").textContent = `${more} more ${more === 1 ? "episode" : "episodes"}${without}`;

  if (!video) return choose(0, 0, false);
  const filmed = data.episodes.map((e, place) => ({ e, place })).filter(({ e }) => e.frame !== null);
  const lastFrame = ({ e }) => e.frame + Math.ceil(e.steps / data.film.every);

  // Captions name the acting skill and its goal, in full screen too.
  load(video, "film", data.film.fps, filmed.flatMap((f) => f.e.calls.map((call) => {
    const [from, to] = [call.age, call.age + call.steps].map((s) => f.e.frame + Math.ceil(s / data.film.every));
    return [from, to, called(call)];
  })));

  const head = make("div", { class: "head" });
  const follow = () => {
    const frame = Math.floor(video.currentTime * data.film.fps + 1e-3);
    const at = filmed.findLast(({ e }) => e.frame <= frame) ?? filmed[0];
    const step = Math.min((frame - at.e.frame) * data.film.every, at.e.steps);
    const over = frame >= lastFrame(at);
    const found = at.e.calls.findLastIndex(({ age }) => age <= step);
    const total = step === 0 ? 0 : at.e.totals[step - 1];
    tracks[at.place].track.append(head);
    head.style.left = `${(100 * step) / at.e.steps}%`;
    $("now").textContent = `Episode ${at.e.number} · step ${step} of ${at.e.steps} · ` +
      `${over ? "over" : called(at.e.calls[found])} · return so far ${signed(total)}`;
    if (!video.paused && (chosen.episode !== at.place || chosen.call !== found)) choose(at.place, found, false);
  };
  video.addEventListener("timeupdate", follow);
  video.addEventListener("seeked", follow);
  const everyFrame = () => {
    follow();
    if (!video.paused) requestAnimationFrame(everyFrame);
  };
  video.addEventListener("play", everyFrame);
  video.addEventListener("loadedmetadata", () => choose(filmed.at(-1).place, 0), { once: true });
})();
